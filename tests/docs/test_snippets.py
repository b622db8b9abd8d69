"""Every ```python block of README.md and docs/ runs: each page in one namespace and a folder of its own."""

import importlib.util
import re
from importlib.metadata import version
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
HOSTS = {"gsplat.md": "gsplat", "nerfacc.md": "nerfacc", "nerfstudio.md": "nerfstudio"}


def blocks(page: Path) -> list[tuple[int, str]]:
    """(line, code) of each ```python block."""
    text = page.read_text(encoding="utf-8")
    found = re.finditer(r"^```python\n(.*?)^```$", text, re.M | re.S)
    return [(text.count("\n", 0, m.start(1)), m.group(1)) for m in found]


def what_the_readme_presupposes() -> dict:
    """The README's reader brings arrays, rays, a loss and a way to draw: here, of the built-in scene."""
    from datamodules.synthetic.config import SyntheticConfig
    from datamodules.synthetic.scene import make_scene
    from visdom_plugin import Render
    from visdom_plugin.geometry.cameras import rays_of

    views = make_scene(SyntheticConfig(size=32, train_views=4, test_views=0)).train
    rays = rays_of(views.cameras, torch.rand(4, 10, 2, dtype=torch.float64) * 32)
    alpha = torch.full((32, 32), 0.5, requires_grad=True)
    return {
        "K": views.cameras.intrinsics,
        "world_from_camera": views.cameras.world_from_camera.numpy(),
        "w": 32,
        "h": 32,
        "masks": views.masks,
        "origins": rays.origins,
        "directions": rays.directions,
        "near": 0.1,
        "far": 20.0,
        "loss": torch.zeros(()),
        "render": lambda camera: Render(torch.zeros(32, 32, 3), alpha, torch.zeros(32, 32)),
    }


@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p)], ids=lambda p: p.name)
def test_the_snippets_of_a_page_run(page, tmp_path, monkeypatch):
    host = HOSTS.get(page.name)
    if host and importlib.util.find_spec(host) is None:
        pytest.skip(f"{host} is not installed")
    if host == "nerfacc" and version(host) == "0.5.2":
        pytest.skip("the page is for nerfacc 0.5.3; nerfstudio has 0.5.2")
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": "snippet"}
    if page.name == "README.md":
        namespace |= what_the_readme_presupposes()
    for line, code in blocks(page):
        # Blank lines keep the page's line numbers in a traceback.
        exec(compile("\n" * line + code, str(page), "exec"), namespace)


def test_the_pages_of_hosts_exist_and_hold_snippets():
    for name in ("your_own_trainer.md", "gsplat.md", "nerfacc.md"):
        assert len(blocks(ROOT / "docs" / name)) >= 4
    assert len(blocks(ROOT / "README.md")) >= 3
