"""visdom-render: draws a run, or any 3DGS point cloud, along a camera path."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast, get_args

import tyro

from visdom_plugin.cli import entry
from visdom_plugin.cli.options import Device, SceneOptions
from visdom_plugin.cli.output.terminal import load_torch, say
from visdom_plugin.cli.subject import Subject, is_splat_file, open_subject
from visdom_plugin.errors import ConfigError, count_of, unknown_name

if TYPE_CHECKING:
    from visdom_plugin.geometry.cameras import Cameras
    from visdom_plugin.hull.hull import Hull
    from visdom_plugin.render import Render
    from visdom_plugin.scene import Scene

NamedPath = Literal["orbit", "between", "train", "test"]
Output = Literal["rgb", "depth", "alpha"]
Format = Literal["mp4", "gif", "png"]
FRAMES, FPS = 120, 24
SPLATS_PX, FIELDS_PX = (640, 1280), (1, 480)
"""At least and at most so long is the longer side of an orbit's pictures, else that of the photographs: splats are
drawn in hundredths of a second, fields in tenths."""
_SMALL_PX, _SMALL_FRAMES = 96, 12
"""Pictures from which the range of depths is found: their longer side, and their number at most."""


@dataclass(frozen=True, kw_only=True)
class Options(SceneOptions):
    """Renders a run from its last checkpoint along a camera path, on white.

    In place of a run it takes the point_cloud.ply of any 3DGS, whoever trained it, and draws it with the cameras
    of the scene that --data names: visdom-render point_cloud.ply --data DIR --path train
    """

    run: tyro.conf.Positional[Path]
    """Run directory, as visdom-train names it, or a .ply, .spz, .splat or .sog file of Gaussians."""
    path: NamedPath | Path = "orbit"
    """orbit: a circle round the object; between: from training view to training view; train, test: these views;
    or a .json file of cameras, as visdom-view and nerfstudio write them (docs/guide/outputs.md)."""
    frames: int | None = None
    """Number of frames along orbit and between, by default 120, five seconds; of a file, its cameras, or so many
    on the way along them."""
    width: int | None = None
    """Width of the pictures in pixels; the height follows, unless it is given. By default the size of training,
    along orbit and between with a longer side of 640 to 1280 pixels for splats, and of 480 at most for fields."""
    height: int | None = None
    """Height in pixels. With both, the view from top to bottom stays, and the sides are cut or widened."""
    outputs: tuple[Output, ...] = ("rgb",)
    """rgb; depth, coloured from near (bright) to far; alpha, the opacity. With png, depth also comes as .npy files
    of float32, in scene units along the camera's axis."""
    fps: int | None = None
    """Frames per second, by default 24, or what the file of cameras says."""
    format: Format | None = None
    """mp4, gif, or png, a folder of numbered images; by default what --out ends in, else mp4."""
    out: Path | None = None
    """File or folder to write; by default <run>/renders/<path>.mp4 or <run>/renders/<path>_frames/, and for
    NAME.ply NAME_<path>.mp4 or NAME_<path>_frames/ beside it. Of several outputs, all but rgb add their name."""
    data: Path | None = None
    """Folder of the scene; for a run, only where its scene has moved."""
    device: Device = "auto"
    """Device to compute on."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return entry.run(_render, argv)


def _render(argv: Sequence[str]) -> None:
    options = _check(tyro.cli(Options, args=argv, prog="visdom-render"))
    load_torch()
    from visdom_plugin.figures.videos import name_codec
    from visdom_plugin.geometry.camera_paths import framed
    from visdom_plugin.training.progress import Progress

    subject = open_subject(options.run, options, options.device, test=options.path == "test")
    cameras, own_fps = cameras_along(options.path, options.frames, subject.scene, subject.hull)
    cameras = framed(cameras, *_choose_size(options, subject, cameras))
    fps = options.fps or own_fps or FPS
    targets = {output: target_of(options, output) for output in dict.fromkeys(options.outputs)}
    _check_targets(options, targets, cameras, fps)
    span = _find_span(subject, cameras) if "depth" in targets else None
    with (
        ExitStack() as stack,
        Progress(len(cameras), title="rendering", unit="frame", quiet=options.quiet) as progress,
    ):
        keep = {
            output: stack.enter_context(_writer(target, options.format, output, fps, span))
            for output, target in targets.items()
        }
        for i in range(len(cameras)):
            render = _draw(subject, cameras[i])
            for add in keep.values():
                add(i, render)
            progress.show(i + 1)
    if not options.quiet and options.format != "png":
        codec = name_codec(Path(f"x.{options.format}"))
        more = ", which browsers do not play (for H.264: pip install 'visdom-plugin[video]')"
        size = f"{int(cameras.width[0])} x {int(cameras.height[0])}"
        lasts = f"{len(cameras) / fps:.1f} s of video"
        say(f"{count_of(len(cameras), 'frame')} of {size}, {lasts}, codec {codec}" + more * (codec == "mp4v"))
    if not options.quiet:
        sys.stdout.write("".join(f"{target}\n" for target in targets.values()))


def _choose_size(options: Options, subject: Subject, cameras: Cameras) -> tuple[int | None, int | None]:
    """Width and height as asked for; where nobody asks, those of a first look, of which the other follows."""
    from visdom_plugin import registry

    if (options.width, options.height) != (None, None) or options.path not in ("orbit", "between"):
        return options.width, options.height
    method = subject.record.get("method") if subject.record else None
    splats = method is None or registry.find(method).hook == "gaussian"
    least, most = SPLATS_PX if splats else FIELDS_PX
    width, height = int(cameras.width[0]), int(cameras.height[0])
    side = min(max(width, height, least), most)
    return (side, None) if width >= height else (None, side)


def _check(options: Options) -> Options:
    """The options with their format; refuses what cannot be, before anything is read."""
    for name in ("frames", "fps", "width", "height"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise ConfigError(f"--{name} is {value}; it must be at least 1")
    if not options.outputs:
        raise ConfigError("no output is named", todo=f"--outputs {' '.join(get_args(Output))}")
    if isinstance(options.path, Path) and not options.path.is_file():
        what = f"there is no camera path {str(options.path)!r}"
        raise unknown_name(
            what, options.path, get_args(NamedPath), where="--path", todo="a .json file, or one of"
        )
    ending = None if options.out is None else options.out.suffix.lower().removeprefix(".")
    kind = options.format or cast(Format | None, ending if ending in get_args(Format) else None)
    if kind is None and options.out is not None:
        raise ConfigError(
            "the name says no format",
            where=f"--out {options.out}",
            todo="end it in .mp4, .gif or .png, or add --format png for a folder of pictures",
        )
    kind = kind or "mp4"
    if kind != "png" and options.out is not None and ending != kind:
        raise ConfigError(
            f"the name of such a video ends in .{kind}",
            where=f"--out {options.out}",
            todo=f"--out NAME.{kind}, or --format png for a folder of pictures",
        )
    return replace(options, format=kind)


def target_of(options: Options, output: str) -> Path:
    """Where an output goes; by default not into renders/test, which is the evaluation's."""
    more = "" if output == "rgb" else f"_{output}"
    if options.out is not None:
        alone = len(set(options.outputs)) == 1
        return (
            options.out if alone else options.out.with_name(f"{options.out.stem}{more}{options.out.suffix}")
        )
    stem = options.path.stem if isinstance(options.path, Path) else options.path
    name = f"{stem}{more}_frames" if options.format == "png" else f"{stem}{more}.{options.format}"
    if is_splat_file(options.run):
        return options.run.with_name(f"{options.run.stem}_{name}")
    return options.run / "renders" / name


def _check_targets(options: Options, targets: Mapping[Output, Path], cameras: Cameras, fps: int) -> None:
    """Refuses what the format cannot hold; removes pictures of a longer path from the run's own folders."""
    from visdom_plugin.figures.videos import GIF_FPS

    if options.format == "png":
        for target in targets.values():
            if target.suffix.lower() != ".png":
                clear_numbered(target, len(cameras), ours=options.out is None)
            elif len(cameras) > 1:
                raise ConfigError(
                    f"{len(cameras)} pictures do not fit into one file",
                    where=f"--out {options.out}",
                    todo=f"name a folder, --format png --out {target.with_suffix('')}; or --frames 1",
                )
        return
    if len(set(zip(cameras.width.tolist(), cameras.height.tolist(), strict=True))) > 1:
        raise ConfigError(
            "the views differ in size, which a video cannot",
            where=f"--path {options.path}",
            todo="give them one size with --width and --height, or write pictures with --format png",
        )
    if options.format == "gif" and fps > GIF_FPS:
        raise ConfigError(
            f"a GIF plays at most {GIF_FPS} frames per second", where=f"--fps {fps}", todo=f"--fps {GIF_FPS}"
        )


@contextmanager
def _writer(
    target: Path, kind: Format | None, output: str, fps: int, span: tuple[float, float] | None
) -> Iterator[Callable[[int, Render], None]]:
    """Takes the renders of a path by their number, and writes one of their outputs."""
    from visdom_plugin.figures.contact_sheet import colour_depth, to_bytes, write_png
    from visdom_plugin.figures.videos import write_clip

    def show(render: Render):
        alpha = render.alpha.detach().float().cpu()
        if output == "depth":
            return colour_depth(render.depth.detach().float().cpu().numpy(), alpha.numpy(), span)
        return to_bytes(render.rgb.detach().cpu() if output == "rgb" else alpha[..., None].expand(-1, -1, 3))

    if kind != "png":
        with write_clip(target, fps) as add:
            yield lambda _, render: add(show(render))
        return

    def write(i: int, render: Render) -> None:
        file = target if target.suffix.lower() == ".png" else target / f"{i:04d}.png"
        write_png(file, show(render))
        if output == "depth":
            _write_array(file.with_suffix(".npy"), render)

    yield write


def _write_array(path: Path, render: Render) -> None:
    import numpy as np

    from visdom_plugin.atomic_files import appearing

    with appearing(path) as part, part.open("wb") as file:
        np.save(file, render.depth.detach().float().cpu().numpy())


def _draw(subject: Subject, camera: Cameras) -> Render:
    import torch

    with torch.no_grad():
        return subject.renderer.render(camera.to(subject.device), torch.ones(3, device=subject.device))


def _find_span(subject: Subject, cameras: Cameras) -> tuple[float, float] | None:
    """The range of depths of a whole path, so that one colour means one depth in all its frames."""
    from visdom_plugin.figures.contact_sheet import depth_span
    from visdom_plugin.geometry.camera_paths import framed

    spans = []
    for i in range(0, len(cameras), -(-len(cameras) // _SMALL_FRAMES)):
        camera = cameras[i]
        wide = int(camera.width) >= int(camera.height)
        camera = framed(camera, _SMALL_PX, None) if wide else framed(camera, None, _SMALL_PX)
        render = _draw(subject, camera)
        spans.append(depth_span(render.depth.detach().cpu().numpy(), render.alpha.detach().cpu().numpy()))
    seen = [s for s in spans if s is not None]
    return (min(s[0] for s in seen), max(s[1] for s in seen)) if seen else None


def clear_numbered(folder: Path, count: int, *, ours: bool) -> None:
    """Sees to it that no picture of a longer path stays beside the `count` that will be written.

    Args:
        ours: whether the folder is the run's own; in any other one nothing is removed.

    Raises:
        ConfigError: there are such pictures in a folder that is not the run's own.
    """
    numbered = [p for ending in ("png", "npy") for p in folder.glob("[0-9]" * 4 + f"*.{ending}")]
    later = [p for p in numbered if p.stem.isdecimal() and int(p.stem) >= count]
    if later and not ours:
        raise ConfigError(
            f"the folder holds numbered pictures beyond the {count} of this path: {min(later).name}",
            where=folder,
            cause="a longer path was rendered into it",
            todo="remove them, or choose another folder with --out",
        )
    for picture in later:
        picture.unlink()


def cameras_along(
    path: NamedPath | Path, frames: int | None, scene: Scene, hull: Hull | None
) -> tuple[Cameras, int | None]:
    """The cameras of a path, (frames,) or its own number, and the frames per second that its file asks for.

    Raises:
        ConfigError: the path is along test views, and there are none.
        SceneError: the file cannot be read.
    """
    import torch

    from visdom_plugin.geometry.camera_paths import orbit, resample, widen
    from visdom_plugin.geometry.cameras import look_at_point
    from visdom_plugin.geometry.path_files import read_path
    from visdom_plugin.seeding import generator

    if path in ("train", "test"):
        views = scene.train if path == "train" else scene.test
        if not len(views):
            raise ConfigError(f"there are no {path} views", where=f"--path {path}", todo="--path orbit")
        return views.cameras, None
    cameras, fps = scene.train.cameras, None
    centre = look_at_point(cameras) if hull is None else torch.as_tensor(hull.centre)
    if path == "orbit":
        circle = orbit(cameras, frames or FRAMES, centre)
        if hull is not None:
            circle = widen(circle, hull.sample_points(1000, generator(0, "orbit")))
        return circle, None
    if isinstance(path, Path):
        cameras, fps = read_path(path, cameras)
        if frames is None:
            return cameras, fps
    return resample(cameras, frames or FRAMES, centre), fps


if __name__ == "__main__":
    sys.exit(main())
