"""One foreground, in every form a mask file can have, reads the same."""

import io

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datamodules.files import masks
from visdom_plugin.errors import SceneError

PIL = pytest.importorskip("PIL.Image")
TRUTH = np.zeros((12, 17), bool)
TRUTH[3:9, 4:15] = True
TRUTH[5, 6] = False


def _pil(mode, image):
    out = io.BytesIO()
    made = PIL.fromarray(image)
    assert made.mode == mode
    made.save(out, "PNG")
    return out.getvalue()


def _cv(image):
    return cv2.imencode(".png", image)[1].tobytes()


def _one_bit():
    out = io.BytesIO()
    PIL.fromarray(TRUTH.astype(np.uint8) * 255).convert("1").save(out, "PNG")
    return out.getvalue()


def _palette():
    out = io.BytesIO()
    image = PIL.fromarray(TRUTH.astype(np.uint8)).convert("P")
    image.putpalette([0, 0, 0, 255, 255, 255] + [9] * 750)
    image.save(out, "PNG")
    return out.getvalue()


GREY = TRUTH.astype(np.uint8) * 255
COLOUR = np.repeat(GREY[..., None], 3, -1)
NOISE = np.random.default_rng(0).integers(0, 256, (12, 17, 3)).astype(np.uint8)
FULL = np.full_like(GREY, 255)
FORMS = {
    "L": lambda: _pil("L", GREY),
    "LA, mask in L": lambda: _pil("LA", np.stack([GREY, FULL], -1)),
    "LA, mask in A": lambda: _pil("LA", np.stack([FULL, GREY], -1)),
    "LA, mask in both": lambda: _pil("LA", np.stack([GREY, GREY], -1)),
    "RGB": lambda: _pil("RGB", COLOUR),
    "RGB, one colour": lambda: _pil("RGB", np.stack([GREY, 0 * GREY, 0 * GREY], -1)),
    "RGBA, mask in RGB": lambda: _pil("RGBA", np.dstack([COLOUR, FULL])),
    "RGBA, cut-out": lambda: _pil("RGBA", np.dstack([NOISE, GREY])),
    "1 bit": _one_bit,
    "palette": _palette,
    "16 bit": lambda: _cv(TRUTH.astype(np.uint16) * 65535),
    "16 bit RGBA": lambda: _cv(
        np.dstack([np.full((12, 17, 3), 40000, np.uint16), TRUTH.astype(np.uint16) * 65535])
    ),
    "JPEG": lambda: cv2.imencode(".jpg", cv2.resize(GREY, None, fx=1, fy=1), [cv2.IMWRITE_JPEG_QUALITY, 100])[
        1
    ].tobytes(),
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_reads_the_same(form, tmp_path):
    mask = masks.decode_mask(FORMS[form](), tmp_path / "mask.png")
    assert np.array_equal(mask.opacity > 0.5, TRUTH)
    assert mask.opacity.dtype == np.float32 and mask.opacity.max() > 0.97
    assert form == "JPEG" or mask.soft == 0


def test_two_masks_in_one_file_are_not_chosen_between(tmp_path):
    data = _pil("LA", np.stack([GREY, GREY[:, ::-1]], -1))
    with pytest.raises(SceneError, match="two different masks"):
        masks.decode_mask(data, tmp_path / "mask.png")


@given(st.floats(0, 1))
@settings(max_examples=20, deadline=None)
def test_soft_pixels_are_counted(share):
    rng = np.random.default_rng(1)
    image = np.where(rng.random((30, 30)) < share, 128, 255).astype(np.uint8)
    assert masks.decode_mask(_cv(image), "mask.png").soft == pytest.approx((image == 128).mean())


def test_sizes_fit_when_they_are_one_picture(tmp_path):
    for full in ((3118, 2078), (801, 599), (48, 36)):
        for factor in (1, 2, 3.7, 4, 8):
            smaller = tuple(round(s / factor) for s in full)
            assert masks.fits(smaller, full) and masks.fits(full, smaller)
    assert not masks.fits((48, 35), (48, 36)) and not masks.fits((36, 48), (48, 36))
    assert not masks.fits((9600, 7200), (48, 36)), "a bomb"


def test_a_file_and_an_alpha_channel_that_disagree_are_both_named(tmp_path):
    one = masks.decode_mask(FORMS["L"](), tmp_path / "cup.png")
    masks.refuse_two(one, one, tmp_path / "masks/cup.png", tmp_path / "images/cup.png")
    twice = masks.Mask(np.kron(one.opacity, np.ones((2, 2), np.float32)), 0.0)
    masks.refuse_two(one, twice, tmp_path / "masks/cup.png", tmp_path / "images/cup.png")
    other = masks.Mask(one.opacity[:, ::-1], 0.0)
    with pytest.raises(
        SceneError, match=r"masks/cup\.png[\s\S]*images/cup\.png[\s\S]*--data\.mask-source folder"
    ):
        masks.refuse_two(one, other, tmp_path / "masks/cup.png", tmp_path / "images/cup.png")


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (0, "found nothing"),
        (1 / 255, "0 and 1"),
        (10 / 255, "10 of 255"),
        (127 / 255, "127 of 255, and only what is above one half"),
        (0.5, "above one half"),
        (0.9, "thinner than a pixel"),
    ],
)
def test_an_empty_mask_says_why(value, said):
    with pytest.raises(SceneError, match=said):
        masks.refuse_empty(np.zeros((3, 3), bool), value, "mask.png")
    masks.refuse_empty(np.ones((3, 3), bool), value, "mask.png")


LABELS = np.where(TRUTH, 1 + np.arange(17) % 3, 0).astype(np.uint8)
COLOURS = [[0, 0, 0], [128, 0, 0], [0, 64, 0], [0, 0, 90]]


def _coloured(indices, colours, kind="PNG"):
    out = io.BytesIO()
    image = PIL.fromarray(indices.astype(np.uint8)).convert("P")
    image.putpalette(np.array(colours, np.uint8).tobytes())
    image.save(out, kind)
    return out.getvalue()


@pytest.mark.parametrize(
    "make",
    [
        lambda: _cv(TRUTH.astype(np.uint8)),
        lambda: _cv(LABELS),
        lambda: _cv(LABELS * 21),
        lambda: _cv(np.dstack([LABELS] * 3)),
        lambda: _cv(LABELS.astype(np.uint16)),
        lambda: cv2.imencode(".tif", LABELS)[1].tobytes(),
        lambda: _coloured(LABELS, COLOURS),
        lambda: _coloured(LABELS, COLOURS, "BMP"),
        lambda: _coloured(LABELS, COLOURS, "TIFF"),
        lambda: _coloured(LABELS, [[70, 0, 0], *COLOURS[1:]]),
        lambda: _coloured(LABELS, [[i] * 3 for i in range(4)]),
    ],
    ids=[
        "0 1", "labels", "to 63", "RGB", "16 bit", "TIFF", "palette", "BMP palette", "TIFF palette",
        "no black", "grey palette",
    ],
)  # fmt: skip
def test_label_images_are_object_where_they_are_not_0(make):
    mask = masks.decode_mask(make(), "mask.png")
    assert mask.labelled and mask.soft == 0
    assert np.array_equal(mask.opacity, TRUTH.astype(np.float32))


OUTLINED = np.zeros((40, 50), np.uint8)
cv2.rectangle(OUTLINED, (8, 8), (34, 30), 2, -1)
cv2.rectangle(OUTLINED, (20, 8), (34, 30), 15, -1)
cv2.rectangle(OUTLINED, (8, 8), (34, 30), 255, 2)
VOC = [[0, 0, 0]] + [[64, 0, 0]] * 254 + [[224, 224, 192]]


@pytest.mark.parametrize(
    "make",
    [
        lambda: _cv(OUTLINED),
        lambda: _cv(np.dstack([OUTLINED] * 3)),
        lambda: _cv(OUTLINED.astype(np.uint16)),
        lambda: _cv(np.where(OUTLINED == 255, 65535, OUTLINED).astype(np.uint16)),
        lambda: _coloured(OUTLINED, VOC),
        lambda: _cv(np.uint8([0, 255, 128])[np.where(OUTLINED == 255, 2, OUTLINED > 0)]),
    ],
    ids=["grey", "RGB", "16 bit", "16 bit, 65535", "palette of Pascal VOC", "trimap"],
)
def test_void_in_label_images_is_unknown(make):
    mask = masks.decode_mask(make(), "mask.png")
    assert mask.labelled and np.array_equal(mask.unknown, OUTLINED == 255)
    assert np.array_equal(mask.opacity > 0.5, (OUTLINED > 0) & (OUTLINED < 255))


def test_colours_of_label_images_are_object_where_they_are_not_black():
    colours = np.uint8([[0, 0, 0], [0, 0, 64], [90, 0, 0], [192, 224, 224]])
    index = np.select([OUTLINED == 255, OUTLINED == 2, OUTLINED == 15], [3, 1, 2], 0)
    mask = masks.decode_mask(_cv(colours[index]), "mask.png")
    assert np.array_equal(mask.unknown, index == 3) and np.array_equal(
        mask.opacity > 0.5, (index > 0) & (index < 3)
    )
    mask = masks.decode_mask(_cv(colours[np.where(index == 3, 1, index)]), "mask.png")
    assert mask.labelled and mask.unknown is None and np.array_equal(mask.opacity > 0.5, index > 0)
    photograph = np.random.default_rng(0).integers(0, 200, (*index.shape, 3)).astype(np.uint8)
    assert not masks.decode_mask(_cv(photograph * (index > 0)[..., None]), "mask.png").labelled


def test_void_that_could_be_the_object_is_refused():
    wide = OUTLINED.copy()
    wide[:, 38:] = 255
    with pytest.raises(SceneError, match=r"wide areas of 255[\s\S]*0 and 255 alone[\s\S]*ignore"):
        masks.decode_mask(_cv(wide), "mask.png")
    alone = masks.decode_mask(_coloured(np.where(OUTLINED > 0, 255, 0), VOC), "mask.png")
    assert alone.unknown is None and np.array_equal(alone.opacity > 0.5, OUTLINED > 0)


def test_what_is_no_label_image_is_read_by_its_brightness():
    soft = cv2.GaussianBlur(GREY, (0, 0), 1)
    dark = np.linspace(0, 60, 12 * 17).reshape(12, 17).astype(np.uint8)
    for image in (
        soft,
        soft[:, :4],
        dark,
        np.where(TRUTH, 255, np.arange(17) % 3 * 9),
        np.where(TRUTH, 64, 0),
    ):
        image = np.ascontiguousarray(image, np.uint8)
        mask = masks.decode_mask(_cv(image), "mask.png")
        assert not mask.labelled and np.array_equal(mask.opacity, image.astype(np.float32) / np.float32(255))
    noise = cv2.imencode(".jpg", LABELS * 9)[1].tobytes()
    assert not masks.decode_mask(noise, "mask.jpg").labelled
    assert not masks.decode_mask(_palette(), "mask.png").labelled, "black and white"
    white_first = masks.decode_mask(_coloured(~TRUTH, [[255, 255, 255], [0, 0, 0]]), "mask.png")
    assert not white_first.labelled and np.array_equal(white_first.opacity > 0.5, TRUTH)


def test_a_palette_whose_order_contradicts_its_colours_is_refused():
    with pytest.raises(SceneError, match=r"black, the usual background, at 1[\s\S]*0 and 255"):
        masks.decode_mask(_coloured(~TRUTH, [[255, 0, 0], [0, 0, 0]]), "mask.png")
