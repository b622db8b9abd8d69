"""Every finished run has a page that needs nothing else; several runs stand on one page side by side."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from tests import browser
from tests.training import fake
from visdom_plugin.cli.commands import report, train
from visdom_plugin.cli.output.reports import repeat_command
from visdom_plugin.figures.contact_sheet import colour_depth
from visdom_plugin.report.page import write_page


def finish(*options: str) -> Path:
    assert train.main(["method:fake", "--quiet", "--seed", "3", "--method.steps", "20", *options]) == 0
    return next(Path().glob("runs/*/*/fake/3"))


class Reader(HTMLParser):
    """Addresses, images without alternative text, and inputs without a name."""

    def __init__(self, text: str):
        super().__init__()
        self.addresses: list[str] = []
        self.nameless: list[str] = []
        self.ids: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.addresses += [found[k] for k in ("src", "href") if found.get(k)]
        self.ids |= {found["id"]} if "id" in found else set()
        if (tag == "img" and "alt" not in found) or (tag == "input" and "aria-label" not in found):
            self.nameless.append(tag)


def test_a_finished_run_has_a_page_that_needs_nothing_else(fakes):
    run = finish()
    text = (run / "report.html").read_text(encoding="utf-8")
    page = Reader(text)
    assert not page.nameless
    for address in page.addresses:
        if address.startswith("#"):
            assert address[1:] in page.ids
        elif not address.startswith("data:"):
            assert (run / address).exists(), address
    assert "http://" not in text.replace("http://www.w3.org", "") and "https://" not in text
    command = re.sub("<[^>]+>", "", re.findall("<code>(.*?)</code>", text)[0])
    assert command.startswith("visdom-train method:fake ")
    assert "--seed 3" in command and "--method.steps 20" in command
    assert len(text) < 5e6


def test_no_report_leaves_it_out_and_it_can_be_made_later(fakes, capsys):
    run = finish("--no-report")
    assert not (run / "report.html").exists() and not (run / "report").exists()
    assert report.main([str(run)]) == 0
    assert capsys.readouterr().out.strip() == str(run / "report.html")
    drawn = (run / "report" / "data.json").stat().st_mtime_ns
    assert report.main([str(run), "--quiet"]) == 0
    assert (run / "report" / "data.json").stat().st_mtime_ns == drawn
    record = json.loads((run / "run.json").read_text())
    record["metrics"]["test"]["psnr"] = 1.0
    (run / "run.json").write_text(json.dumps(record))
    assert report.main([str(run), "--quiet"]) == 0
    assert (run / "report" / "data.json").stat().st_mtime_ns > drawn


def _dotted(text: str) -> list[str]:
    """The dotted lines of a page's curves."""
    found = re.findall(r'<path d="([^"]+)"[^>]*stroke-dasharray: ?1,', text[text.index('id="curves"') :])
    assert len(found) == 3
    return found


def test_what_a_method_says_of_its_steps_is_marked_in_the_curve(fakes, monkeypatch):
    events = {"opacities reset": [5, 10], "nothing": [], "last Gaussians added": [15]}
    monkeypatch.setattr(fake.FakeMethod, "events", lambda self: events, raising=False)
    run = finish()
    assert json.loads((run / "run.json").read_text())["events"] == events
    text = (run / "report.html").read_text(encoding="utf-8")
    assert "Dotted: opacities reset after step 5, 10; last Gaussians added after step 15." in text
    curves = text[text.index('id="curves"') :]
    assert curves.count("<title>opacities reset</title>") == 2 and "nothing" not in curves
    record = json.loads((run / "run.json").read_text())
    # A schedule that is longer than what the config calls its steps.
    longer = record | {"config": record["config"] | {"steps": 10}}
    (run / "run.json").write_text(json.dumps(longer))
    assert report.main([str(run), "--quiet"]) == 0
    assert _dotted((run / "report.html").read_text(encoding="utf-8")) == _dotted(text)
    (run / "run.json").write_text(json.dumps(record | {"events": {}}))
    assert report.main([str(run), "--quiet"]) == 0
    assert "Dotted" not in (run / "report.html").read_text(encoding="utf-8")


def test_two_runs_stand_side_by_side(fakes):
    first = finish().rename("first")
    second = finish("--method.lr", "0.2")
    assert report.main([str(first), str(second), "--out", "both.html"]) == 0
    text = Path("both.html").read_text(encoding="utf-8")
    assert "fake, first" in text and f"fake, {second}" in text
    # The better one is marked, in every row with a difference.
    record = [json.loads((r / "run.json").read_text())["metrics"]["test"]["psnr"] for r in (first, second)]
    marked = re.findall(r'class="best"><strong>([\d.]+)', text)
    assert f"{max(record):.2f}" in marked
    # None is, where they cannot be compared.
    other = json.loads((second / "run.json").read_text())
    other["data"]["hashes"] = {"train_views": "of others"}
    (second / "run.json").write_text(json.dumps(other))
    write_page(Path("apart.html"), [first, second])
    text = Path("apart.html").read_text(encoding="utf-8")
    assert "cannot be compared" in text and 'class="best"' not in text


def test_bad_input_gets_one_clear_line(fakes, tmp_path, capsys):
    run = finish("--no-report")
    record = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(record | {"status": "interrupted"}))
    for words, said in (
        ([str(tmp_path)], "not a run directory"),
        ([str(run)], "has not finished"),
        ([], "no run is named"),
        ([str(run), "--out", "page.txt"], "ends in .html"),
    ):
        assert report.main(words) == 2
        assert said in capsys.readouterr().err
    assert not (run / "report.html").exists()


def test_a_report_that_fails_leaves_the_run_finished(fakes, monkeypatch, caplog):
    from visdom_plugin.cli.output import reports

    def broken(*_, **__):
        raise OSError("no room")

    monkeypatch.setattr(reports, "report_finished", broken)
    run = finish()
    assert json.loads((run / "run.json").read_text())["status"] == "finished"
    assert "no room" in caplog.text


def test_the_command_that_repeats_a_run_is_read_back_to_its_settings(tmp_path):
    folder = tmp_path / "my scene"
    folder.mkdir()
    from visdom_plugin import registry
    from visdom_plugin.cli import options
    from visdom_plugin.training.runs.config_io import as_plain

    preset = registry.find("3dgs-go+vd")
    config = as_plain(preset.quick) | {"steps": 123}
    config["vd"] = config["vd"] | {"enabled": False}
    data = {"path": str(folder), "views": 6, "downscale": 2.0, "mask_source": "alpha"}
    record = {"method": preset.name, "seed": 7, "budget": "quick", "config": config, "data": data}
    import shlex

    request = options.parse(shlex.split(repeat_command(record))[1:])
    assert as_plain(request.config) == config
    assert request.common.data == folder and request.common.seed == 7
    assert (request.common.views, request.common.downscale, request.common.mask_source) == (6, 2.0, "alpha")


def test_near_is_brighter_than_far_in_depth():
    depth = np.tile(np.linspace(1, 2, 50), (20, 1))
    picture = colour_depth(depth, np.ones_like(depth)).sum(-1).astype(int)
    assert picture[0, 2] > picture[0, 25] > picture[0, -3]
    assert (colour_depth(depth, np.zeros_like(depth)) == 255).all()


@browser.needed
@pytest.mark.slow
def test_people_can_use_the_page(fakes):
    address = (finish() / "report.html").resolve().as_uri()
    with browser.Page() as page:
        page.size(1000, 900)
        page.prefer("light")
        page.open(address)
        assert page.run("[...document.images].every(i => i.complete && i.naturalWidth > 0)")
        page.run("document.querySelector('.compare').scrollIntoView()")
        light = page.picture()

        # By keyboard: End goes all the way to the render, Home to the photograph.
        page.run("document.querySelector('.slider input').focus()")
        page.press("End", 35)
        assert page.run("document.querySelector('.compare').style.getPropertyValue('--cut')") == "0%"
        render = page.picture()
        page.press("Home", 36)
        truth = page.picture()
        assert (render != light).any() and (truth != light).any() and (truth != render).any()

        before = page.run("getComputedStyle(document.querySelector('.orbit img')).transform")
        page.run("document.getElementById('play').click()")
        page.until(f"getComputedStyle(document.querySelector('.orbit img')).transform != '{before}'")
        page.run("document.getElementById('play').click()")

        page.prefer("dark")
        assert page.run("getComputedStyle(document.body).backgroundColor") != "rgb(255, 255, 255)"
        assert page.picture()[0, 0].mean() < 80 < light[0, 0].mean()

        for width in (320, 420, 1600):
            page.size(width, 800)
            assert page.run("document.documentElement.scrollWidth <= innerWidth"), width
        assert page.run("getComputedStyle(document.querySelector('.paper')).display") == "none"
        page.call("Emulation.setEmulatedMedia", media="print")
        assert page.run("getComputedStyle(document.querySelector('.paper')).display") == "block"
        assert page.run("getComputedStyle(document.querySelector('.slider')).display") == "none"
        assert page.run("getComputedStyle(document.querySelector('.over')).position") == "static"
        assert page.errors == []
