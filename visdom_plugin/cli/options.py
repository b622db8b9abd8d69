"""Options of the commands, and the parse of a command line into a method, its settings and these options.

Later wins: preset (by budget), then the file of --config, then the command line.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, make_dataclass, replace
from dataclasses import field as dataclass_field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn, cast, get_args

import tyro

from datamodules.built_in import on_disk
from datamodules.recognise import FORMATS, find_folder
from visdom_plugin import registry
from visdom_plugin.cli.early import WORD, Early, read_early
from visdom_plugin.errors import ConfigError, unknown_name
from visdom_plugin.hull.settings import HullSettings
from visdom_plugin.training.runs.config_io import as_plain, differences, from_plain, read_mapping

if TYPE_CHECKING:
    DataFormat = str
else:
    DataFormat = Literal[tuple(FORMATS)]
Device = Literal["auto", "cpu", "cuda"]
Budget = Literal["quick", "standard", "full"]
READING = (
    "views", "downscale", "seed", "missing_masks", "mask_source", "data_format", "train_list", "test_list",
    "split", "frame", "masks", "colmap_model", "invert_masks", "mask_path", "allow_outside",
)  # fmt: skip
"""Common options that say how a scene is read, kept in run.json to read it again."""


@dataclass(frozen=True)
class Reading:
    """Options of every command that opens a scene on disk."""

    data_format: DataFormat | None = None
    """Layout of the scene's folder; detected by default."""
    train_list: str | None = None
    """Training views to use in place of --views: positions and names with commas between; a text file of
    zero-based positions, an index file; or all."""
    test_list: str | None = None
    """Test views, in the same way."""
    split: str | None = None
    """A published split: visdom, or visdom:SCENE where the folder is not named after the data set's scene."""
    frame: int | None = None
    """Frame of a video layout (ActorsHQ); by default the first one present."""
    masks: str | None = None
    """Folder of the foreground masks, inside the scene's; by default masks, or one with a similar name."""
    colmap_model: str | None = None
    """Folder of the COLMAP model, such as sparse/1; by default the one with the most registered photographs."""
    invert_masks: bool = False
    """Invert masks that are black on the object."""
    mask_path: Literal["ignore", "foreground"] = "ignore"
    """Meaning of mask_path in a transforms.json: black pixels are ignored (nerfstudio), or white is the object."""
    allow_outside: bool = False
    """Allow the scene to name files outside its folder."""


@dataclass(frozen=True)
class SceneOptions(Reading):
    """Options of every command that reads training views."""

    data: Path | None = None
    """Folder of the scene, or a built-in, procedural one: builtin:watering-can (the default), builtin:duck,
    builtin:figure, builtin:chair."""
    views: int = 4
    """Number of training views; a scene that has no more trains on all of them."""
    downscale: float = 1.0
    """Factor to downscale images by."""
    missing_masks: Annotated[Literal["error", "colour", "hull"], tyro.conf.arg(name="data.missing-masks")] = (
        "error"
    )
    """Training views without a mask: an error; for colour only, inside the hull of the other views; or that hull's
    outline becomes their mask. Test views without one are then rendered, not measured. Commands that do not train
    leave such views out."""
    mask_source: Annotated[Literal["auto", "folder", "alpha"], tyro.conf.arg(name="data.mask-source")] = (
        "auto"
    )
    """Where masks are read: their folder, the photographs' alpha channel, or whichever there is."""
    seed: int = 0
    """Random seed."""
    quiet: bool = False
    """Print nothing but errors."""


@dataclass(frozen=True)
class FolderOptions(SceneOptions):
    """Options of the commands that take the scene as a word of its own, too."""

    folder: tyro.conf.Positional[Path | None] = None
    """Folder of the scene, or a built-in, procedural one: builtin:watering-can (the default), builtin:duck,
    builtin:figure, builtin:chair."""

    @property
    def scene_folder(self) -> Path | None:
        """The scene that was named, in one of two ways.

        Raises:
            ConfigError: two are named.
        """
        if self.folder is not None and self.data is not None and self.folder != self.data:
            raise ConfigError(f"two scenes: {self.folder} and {self.data}", todo="name one")
        return self.folder or self.data

    def find_scene_folder(self) -> Path | None:
        """The scene that was named; asked before what takes seconds to import.

        Raises:
            ConfigError: two are named, or a built-in scene that is not there.
            SceneError: there is no such folder.
        """
        named = self.scene_folder
        return named if named is None or on_disk(named) is None else find_folder(named)


@dataclass(frozen=True)
class Common(FolderOptions):
    """Options of every training run."""

    device: Device = "auto"
    """Device to compute on; auto takes CUDA where available."""
    budget: Literal["auto", "quick", "standard", "full"] = "auto"
    """quick: a minute or two on two CPU cores; standard: up to ten, for methods that have such settings; full: the
    published schedule; auto: quick on CPU, full on CUDA."""
    out: Path | None = None
    """Run directory; by default runs/<scene>/<views>/<method>/<seed>."""
    overwrite: bool = False
    """Discard the run in the run directory: another run, or this one if it has finished or failed. This run, if it
    was interrupted, is resumed all the same."""
    checkpoint_seconds: float = 30.0
    """Seconds between checkpoints; results do not depend on it."""
    snapshots: int = 0
    """States to keep besides the newest, evenly spaced over the schedule, for visdom-eval --oracle; results do not
    depend on it."""
    config: Path | None = None
    """YAML file with settings, as --show-config prints them."""
    view: bool = False
    """Show the training in the browser, from its first checkpoint to its end; visdom-view shows it afterwards."""
    report: bool = True
    """End with report.html in the run directory, one page that shows what came out."""
    tensorboard: Path | None = None
    """Folder for TensorBoard's files, one per run, with numbers and pictures; needs the extra tensorboard."""
    show_config: bool = False
    """Print all settings as YAML and exit."""


SAVED = ("data", *READING, "device", "budget")
"""Common options that a config file holds beside `method` and `settings`."""


@dataclass(frozen=True)
class Request:
    """What the user asked for, resolved."""

    preset: registry.Preset
    config: Any
    """The method's settings."""
    common: Common
    """`budget` is not "auto" here."""
    note: str
    """One line on which budget was chosen and why."""


def parse(
    argv: Sequence[str],
    prog: str = "visdom-train",
    find: Callable[[str], registry.Preset] = registry.find,
) -> Request:
    """Reads the command line.

    Args:
        find: a method's name to its preset.

    Raises:
        ConfigError: for an unknown or missing method, and for everything wrong in the file.
        SystemExit: by tyro, for --help (0) and for unknown options or values (2).
    """
    early = read_early(argv)
    early = _find_method(early)
    named = name_method(early)
    file, where = ({}, "") if early.config is None else (_read(Path(early.config)), early.config)
    name = named or file.get("method")
    if name is None:
        _without_method(early, prog)
    preset = find(str(name))
    if named and "method" in file and find(str(file["method"])) != preset:
        raise ConfigError(
            f"the file is for method:{file['method']}, the command line says {WORD}{named}",
            where=where,
            todo=f"make one for it: {prog} {WORD}{named} --show-config > FILE",
        )
    asked = early.budget or file.get("budget", "auto")
    device = early.device or file.get("device", "auto")
    budget, note = choose_budget(asked, device, ask_torch=not early.help)
    config = preset.settings(budget)
    common = Common()
    if file:
        given = {k: v for k, v in file.items() if k in SAVED}
        common = from_plain(common, given, where)
        changed = from_plain(config, file.get("settings") or {}, where, "settings")
        count = len(differences(as_plain(config), as_plain(changed)))
        config, note = changed, f"{note}; {count} settings changed by {where}"
    common = replace(common, budget=budget)
    # One class for both, so that common options and those of the method stand in any order.
    method = dataclass_field(default=config)
    combined = make_dataclass("Train", [("method", type(config), method)], bases=(Common,), frozen=True)
    parsed = tyro.cli(
        combined,
        prog=f"{prog} {WORD}{preset.name}",
        description=f"{preset.name}: {preset.description}. Defaults shown: {note}.",
        default=combined(**{f.name: getattr(common, f.name) for f in fields(Common)}, method=config),
        args=[_spell_out(word) for word in early.rest],
        config=(tyro.conf.AvoidSubcommands,),
    )
    common = Common(**{f.name: getattr(parsed, f.name) for f in fields(Common)})
    if common.snapshots < 0:
        raise ConfigError(f"--snapshots {common.snapshots} is out of range", todo="give 0 or more")
    common = replace(common, budget=budget, data=common.scene_folder, folder=None)
    return Request(preset, parsed.method, common, note)


def _spell_out(word: str) -> str:
    """`--k` and `-k`, as the other commands spell K, as the method's setting."""
    name, equals, value = word.partition("=")
    return f"--method.hull.k{equals}{value}" if name in ("--k", "-k") else word


def _find_method(early: Early) -> Early:
    """A method's name without the word before it is taken for the method where none is named."""
    known = registry.installed()
    for i, word in enumerate(early.rest):
        is_value = i > 0 and early.rest[i - 1].startswith("-")
        if not early.methods and not is_value and (word in known.presets or word in known.aliases):
            return replace(early, methods=(word,), rest=(*early.rest[:i], *early.rest[i + 1 :]))
    return early


def name_method(early: Early) -> str | None:
    """The method that the command line names; None where it names none.

    Raises:
        ConfigError: it names several.
    """
    if len(early.methods) > 1:
        raise ConfigError(f"one method at a time, please: {' '.join(WORD + name for name in early.methods)}")
    return early.methods[0] if early.methods else None


def most_views(options: SceneOptions) -> int | None:
    """How many views train at most, by the options alone; None where a file or the scene tells."""
    listed = options.train_list
    if listed is None:
        return options.views
    return None if listed == "all" or Path(listed).exists() else len(list(filter(None, listed.split(","))))


def refuse_large_k(options: SceneOptions, hull: Any) -> None:
    """Raises ConfigError where a hull's K is above the number of views that the options ask for.

    Args:
        hull: settings of a hull; anything else has no K.
    """
    views = most_views(options)
    if views is not None and isinstance(hull, HullSettings):
        hull.require_views(views)


def read_options(options: Any) -> dict[str, Any]:
    """How a command's options say that the scene is read; index files by their full path."""
    return resolve_lists({name: getattr(options, name) for name in READING})


def resolve_lists(reading: dict[str, Any]) -> dict[str, Any]:
    """Options on reading with index files by their full path; lists of views stay as they are."""
    lists = [name for name in ("train_list", "test_list") if reading.get(name) is not None]
    files = {name: Path(reading[name]) for name in lists if Path(reading[name]).is_file()}
    return reading | {name: str(path.resolve()) for name, path in files.items()}


def describe_reading(common: Common) -> dict[str, Any]:
    """How the scene was asked for, as run.json notes it, so that it can be loaded again."""
    folder = on_disk(common.data)
    path = common.data if folder is None else folder.expanduser().resolve()
    reading = read_options(common)
    if folder is not None and common.masks is not None and not (folder / common.masks).is_dir():
        # The run is opened again from any working directory.
        reading["masks"] = str(Path(common.masks).expanduser().resolve())
    return {"path": None if path is None else str(path), **reading}


def dump(request: Request) -> str:
    """The YAML that `--config` reads back to the same request."""
    import yaml

    common = as_plain(request.common)
    content = {"method": request.preset.name, **{k: common[k] for k in SAVED}}
    content["settings"] = as_plain(request.config)
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


def _without_method(early: Early, prog: str) -> NoReturn:
    known = registry.installed()
    if early.help:
        lines = [f"{WORD}{p.name}: {p.description}." for p in known.presets.values()]
        tyro.cli(
            Common,
            prog=f"{prog} {WORD}NAME",
            description="Trains a method on posed, masked photographs.\n\n"
            + "\n\n".join(lines)
            + f"\n\nSettings of one method: {prog} {WORD}NAME --help",
            args=["--help"],
        )
    stray = [a for a in early.rest if a in known.presets or a in known.aliases]
    if stray:
        raise ConfigError(f"a method is named with {WORD} before it", todo=f"{prog} {WORD}{stray[0]}")
    raise ConfigError(
        "no method is named",
        todo=f"for example: {prog} {WORD}zipnerf+vd\n  methods: "
        + ", ".join(f"{WORD}{n}" for n in known.presets)
        + f"\n  help: {prog} --help",
    )


def choose_budget(budget: str, device: str, ask_torch: bool = True) -> tuple[Budget, str]:
    """ "quick", "standard" or "full", and why, from the options --budget and --device.

    Without `ask_torch`, a driver is taken for a CUDA device.
    """
    if budget in get_args(Budget):
        return cast(Budget, budget), f"budget {budget}"
    # Help must not wait for torch: without a driver there is no CUDA, and with one it is the likely case.
    if device == "auto":
        device = "cuda" if may_use_cuda(device) else "cpu"
        if device == "cuda" and ask_torch:
            device = resolve_device("auto")
    chosen: Budget = "full" if device == "cuda" else "quick"
    return chosen, f"budget {chosen}, chosen for device {device}"


def may_use_cuda(device: str) -> bool:
    """Whether --device asks for CUDA, or finds a driver where it asks for nothing; without torch."""
    return device == "cuda" or (device == "auto" and Path("/dev/nvidiactl").exists())


def resolve_device(device: str) -> str:
    """ "cpu" or "cuda" for "auto" and the rest.

    Raises:
        ConfigError: for CUDA where there is none.
    """
    import torch

    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if device == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            "there is no CUDA device",
            where="--device cuda",
            cause="no NVIDIA driver, or a CPU build of torch",
            todo="leave --device out, or see what `visdom-methods --doctor` finds",
        )
    return device


def _read(path: Path) -> dict[str, Any]:
    content = read_mapping(path, "the config file")
    valid = ("method", *SAVED, "settings")
    for key in content:
        if key not in valid:
            what = f"unknown setting {key!r}"
            raise unknown_name(what, key, valid, where=path, todo="valid names at the top level")
    return content
