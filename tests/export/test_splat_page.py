"""The page of Gaussians shows the object as large as it can, whatever the scene's unit."""

import json
import math
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests import browser
from tests.splat.twin import make_gaussians
from visdom_plugin.errors import ConfigError
from visdom_plugin.export import splat_page
from visdom_plugin.export.splat_files import read_splats, write_splats
from visdom_plugin.splat.gaussians import Gaussians

PAGE = (
    "<title>SuperSplat Viewer</title><script>const a = {settings: x}; const b = {settings: "
    '{"version":2,"tonemapping":"none","background":{"color":[0.4,0.4,0.4]},"cameras":[]}, c: 1}</script>'
)


def in_unit(gaussians, unit):
    """The same Gaussians, in a unit of which there are so many in one of theirs."""
    return replace(
        gaussians, means=gaussians.means * unit, log_scales=gaussians.log_scales + math.log(unit)
    ).detach()


@pytest.fixture
def handed(monkeypatch):
    """What splat-transform is handed; it writes PAGE."""
    read = []

    def stand_in(source, target, *, asked):
        read.append(read_splats(source))
        target.write_text(PAGE)

    monkeypatch.setattr(splat_page, "splat_transform", stand_in)
    return read


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e4])
def test_a_page_is_the_same_in_every_unit(tmp_path, handed, unit):
    plain = make_gaussians(n=400, dtype=torch.float32).detach()
    eye = torch.tensor([3.0, -1.0, 2.0], dtype=torch.float64)
    for name, scale in (("one", 1.0), ("other", unit)):
        write_splats(tmp_path / f"{name}.html", in_unit(plain, scale), title="<a> & b", eye=eye * scale)
    first, second = handed
    assert torch.allclose(first.means, second.means, atol=1e-5)
    assert torch.allclose(first.log_scales, second.log_scales, atol=1e-4)
    one, other = ((tmp_path / f"{name}.html").read_text() for name in ("one", "other"))
    assert "<title>&lt;a&gt; &amp; b</title>" in one and "const a = {settings: x}" in one
    settings = [json.JSONDecoder().raw_decode(text, text.index('{"version"'))[0] for text in (one, other)]
    assert settings[0]["background"] == {"color": [1, 1, 1]} and settings[0]["tonemapping"] == "none"
    at = [np.array(found["cameras"][0]["initial"]["position"]) for found in settings]
    assert np.allclose(at[0], at[1], atol=1e-4)
    # 99 % of the Gaussians are nearer to the middle than 1; the camera stands where it was asked to, half a turn
    # about z.
    assert float(first.means.norm(dim=1).quantile(0.98)) <= 1 and 1.5 < np.linalg.norm(at[0]) < 6
    middle, _ = splat_page._measure(plain)
    wanted = ((eye - middle) * torch.tensor([-1.0, -1.0, 1.0])).numpy()
    assert np.allclose(at[0] / np.linalg.norm(at[0]), wanted / np.linalg.norm(wanted), atol=1e-6)


def test_another_viewers_page_stays_as_it_is_and_a_single_gaussian_has_one(tmp_path, handed):
    assert splat_page._look_at_object("<html></html>", "x", torch.ones(3)) == "<html></html>"
    write_splats(tmp_path / "one.html", make_gaussians(n=1, dtype=torch.float32).detach())
    assert "<title>one</title>" in (tmp_path / "one.html").read_text()
    assert bool(torch.isfinite(handed[0].means).all())


@browser.needed
@pytest.mark.slow
@pytest.mark.parametrize("unit", [0.05, 20.0])
def test_the_object_fills_the_page(tmp_path, unit):
    n = 3000
    points = torch.nn.functional.normalize(
        torch.randn(n, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    turn = torch.tensor([1.0, 0, 0, 0]).expand(n, 4).contiguous()
    dark = torch.full((n, 1, 3), -1.7)
    ball = Gaussians(points, torch.full((n, 3), math.log(0.05)), turn, torch.full((n,), 6.0), dark)
    try:
        write_splats(tmp_path / "ball.html", in_unit(ball, unit))
    except ConfigError as error:
        pytest.skip(f"splat-transform cannot be had here: {error}")
    with browser.Page() as page:
        page.size(900, 600)
        page.open((tmp_path / "ball.html").as_uri())
        until = time.monotonic() + 90
        share = 0.0
        while share < 0.1 and time.monotonic() < until:
            time.sleep(1)
            share = float((page.picture()[100:-100].max(-1) < 100).mean())
        corner = page.picture()[300, 5]
    # A disc that touches the top of a 900 x 600 page has a share of 0.52; what is cut off here has less.
    assert 0.3 < share < 0.9
    assert corner.min() > 240
