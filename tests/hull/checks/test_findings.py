"""What several views have in common is one finding; what is said of the fit beside findings."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from datamodules import load
from tests.hull.checks.faults import capture_of
from visdom_plugin.cli.commands.check import describe_check, summarise_fit
from visdom_plugin.hull.checks.check import check
from visdom_plugin.hull.checks.findings import Name, spell_range


@pytest.fixture(scope="module")
def sound():
    return capture_of(load(None, views=6, downscale=2, test=False).train)


def specked(mask, seed):
    spots = torch.from_numpy(np.random.default_rng(seed).uniform(size=mask.shape) < 0.004 * seed)
    return mask ^ spots


SPOILT = {
    "empty": lambda mask, i: torch.zeros_like(mask),
    "full": lambda mask, i: torch.ones_like(mask),
    "size": lambda mask, i: mask[:-10],
    "speckled": specked,
    "border": lambda mask, i: torch.roll(mask, mask.shape[1] // 2, 1),
}


def spoil(capture, kind, views):
    masks = [SPOILT[kind](m, i) if i in views else m for i, m in enumerate(capture.masks)]
    return replace(capture, masks=tuple(masks))


@pytest.mark.parametrize("kind", SPOILT)
def test_masks_with_one_fault_are_one_finding(sound, kind):
    views = (1, 3, 4)
    spoilt = spoil(sound, kind, views)
    found = check(spoilt.cameras, spoilt.masks, names=spoilt.names)
    (said,) = (f for f in found.findings if f.kind == kind)
    assert said.views == views
    assert said.what.startswith(f"the masks of {Name(spoilt.names).all_of(views)} ")
    one = spoil(sound, kind, (4,))
    (said,) = (f for f in check(one.cameras, one.masks, names=one.names).findings if f.kind == kind)
    assert said.views == (4,) and said.what.startswith(f"the mask of {spoilt.names[4]} ")


def test_masks_of_other_sizes_are_told_apart(sound):
    masks = [m[: len(m) - 10 * (i % 3)] for i, m in enumerate(sound.masks)]
    found = [f for f in check(sound.cameras, masks, names=sound.names).findings if f.kind == "size"]
    assert [f.views for f in found] == [(1, 4), (2, 5)]


def test_copies_of_one_mask_are_one_finding(sound):
    masks = [sound.masks[0]] * 3 + list(sound.masks[3:])
    (said,) = (f for f in check(sound.cameras, masks, names=sound.names).findings if f.kind == "duplicate")
    assert said.views == (0, 1, 2) and "all but one" in said.todo
    assert said.what.startswith(Name(sound.names).all_of((0, 1, 2)))


def test_numbers_of_several_views_are_a_range():
    assert spell_range([3, 12, 5], "d") == "3 to 12" and spell_range([0.101, 0.1], ".0%") == "10%"


def summary(capture, masks):
    found = check(capture.cameras, masks, names=capture.names)
    return found, summarise_fit(describe_check(found, capture.names))


def test_a_fit_is_called_perfect_only_where_nothing_was_found(sound):
    _, said = summary(sound, sound.masks)
    assert any("0 is a perfect fit" in line for line in said)
    found, said = summary(sound, spoil(sound, "full", (1,)).masks)
    assert found.findings and not any("perfect" in line for line in said)
    assert any(line.startswith("Apart from what was found, masks and cameras miss") for line in said)


def test_masks_that_rule_nothing_out_are_not_said_to_fit(sound):
    near = [torch.ones_like(m) for m in sound.masks]
    for mask in near:
        mask[:1] = False
    found, said = summary(sound, near)
    assert found.fit is not None and found.findings
    assert not any("miss each other" in line for line in said)
    assert any("rule out nothing" in line for line in said)
