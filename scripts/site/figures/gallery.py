"""docs/gallery.md and its pictures: unseen views of the built-in scenes by five methods, with their numbers.

python scripts/site/figures/gallery.py [--runs DIR]

Trains what is not in DIR yet, half a minute to a minute each.
"""

from __future__ import annotations

from textwrap import fill
from typing import Any, NamedTuple

from before_after import PICTURES, TITLES, compare, write_webp
from trained import read_options, train

from datamodules import load
from visdom_plugin.training.runs.run_directory import read_record


class Shown(NamedTuple):
    """What the page shows of one scene."""

    title: str
    views: tuple[int, int]
    """Test views."""
    words: str


SCENES = {
    "watering-can": Shown(
        "Watering can",
        (1, 14),
        "Hollow, with thin parts. Bare splatting breaks bail, spout and handle; `visdom-gs` keeps them whole. The "
        "waist above the foot stays filled in all of them, because the four outlines leave it open.",
    ),
    "duck": Shown(
        "Duck",
        (1, 7),
        "Glossy: the reflection of a window moves with the camera. The visible domain alone brings splatting "
        "nothing here. `visdom-gs` has the rounder outline, but is behind inside the mask, where the reflections "
        "are.",
    ),
    "figure": Shown(
        "Figure",
        (2, 12),
        "A person-like shape whose limbs hide one another. `visdom-gs` gains more here than on the other scenes. "
        "The visible domain alone makes splatting better inside the mask, and worse over the whole picture.",
    ),
    "chair": Shown(
        "Chair",
        (2, 12),
        "Rods three to five pixels thick, and more air than wood. The rods of the back survive in all but bare "
        "Instant-NGP. Splatting smears the rungs below the seat.",
    ),
}
METHODS = ("ingp", "ingp+vd", "3dgs-go", "3dgs-go+vd", "visdom-gs")
MAKES = tuple(f"gallery/{name}.webp" for name in SCENES)
HEAD = """# Gallery

To choose a method by eye: the four built-in scenes from **four photographs**, in views that no method has seen,
beside the truth. The scenes are drawn when they are asked for, so every command here runs as it stands. The small
pictures at the left are all that a method gets, with their masks and poses.

`ingp` is a radiance field, `3dgs-go` is Gaussian splatting, and `+vd` adds the [visible domain](concepts.md).
`visdom-gs` is `3dgs-go+vd` that starts in the [shape inside the hull](concepts.md#the-shape-inside-the-hull).
All have the budget `quick`, seed 0 and one thread. Numbers are means over 16 unseen views. PSNR and SSIM
compare whole pictures on white. "Inside the mask" is the PSNR of the object's pixels alone. IoU is the overlap
of outlines, 1 at best ([glossary](guide/glossary.md)).

This page and its pictures are made by `scripts/site/figures/gallery.py`. More seeds, and real photographs, are
in the [findings](findings/methods.md).
"""


def main() -> None:
    """Draws the pictures and writes the page."""
    args = read_options(__doc__)
    (PICTURES / "gallery").mkdir(exist_ok=True)
    parts = [HEAD]
    for (scene, shown), picture in zip(SCENES.items(), MAKES, strict=True):
        runs = [train(args.runs, method, scene=scene) for method in METHODS]
        found = load(f"builtin:{scene}", views=4)
        write_webp(compare(found, runs, shown.views), PICTURES / picture, 80)
        parts.append(section(scene, shown, picture, [read_record(run) for run in runs]))
    PICTURES.with_name("gallery.md").write_text("\n".join(parts), encoding="utf-8")


def section(scene: str, shown: Shown, picture: str, records: list[dict[str, Any]]) -> str:
    """What the page says of one scene."""
    rows = [
        f"| `{record['method']}` | {found['psnr']:.2f} | {found['psnr_foreground']:.2f} | {found['ssim']:.3f} "
        f"| {found['silhouette_iou']:.3f} |"
        for record in records
        for found in [record["metrics"]["test"]]
    ]
    columns = ", ".join(TITLES[method].replace("\n", " ") for method in METHODS)
    lines = [
        f"## {shown.title}",
        "",
        fill(shown.words, 120),
        "",
        f"![{shown.title}: four photographs; two unseen views: truth, {columns}](pictures/{picture})",
        "",
        "| method | PSNR, dB | inside the mask, dB | SSIM | IoU |",
        "| --- | --- | --- | --- | --- |",
        *rows,
        "",
        "```",
        f"for m in method:{{{','.join(METHODS)}}}; do",
        f"  OMP_NUM_THREADS=1 visdom-train $m --data builtin:{scene} --views 4 --budget quick \\",
        f"    --out runs/{scene}/${{m#method:}}",
        "done",
        "```",
        "",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
