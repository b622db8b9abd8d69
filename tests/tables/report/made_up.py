"""Tables whose runs never ran: specs and outcomes drawn by hypothesis or from a seed."""

import random
from pathlib import Path

from hypothesis import strategies as st

from visdom_plugin.tables.results import Job, Outcome, Results
from visdom_plugin.tables.spec import Column, Row, TableSpec

PSNR_PLACE = {"dataset": "MipNeRF360"}
PLACES = [{"method": m, "variant": "vd"} for m in ("INGP", "ZipNeRF", "3DGS-GO", "CoR-GS")]
STATUSES = ("finished", "finished", "finished", "failed", "running", "waiting", "not available", "no data")


def make_spec(rows=3, columns=2, scenes=2, views=(4, 6), seeds=(0, 1, 2), metrics=("psnr", "ssim"), **more):
    """A table; `rows` may be labels."""
    labels = [f"row {i}" for i in range(rows)] if isinstance(rows, int) else list(rows)
    return TableSpec(
        name="made-up",
        rows=tuple(
            Row(label, "ingp", group=f"group {i % 2}", paper=PLACES[i % 4]) for i, label in enumerate(labels)
        ),
        columns=tuple(
            Column(f"data {c}", "root", tuple(f"scene{c}{s}" for s in range(scenes)), views, paper=PSNR_PLACE)
            for c in range(columns)
        ),
        seeds=tuple(seeds),
        metrics=tuple(metrics),
        **{"paper": "main_sota", "layout": {"mean": True}} | more,
    )


def list_places(spec):
    """(row, column, scene, views, seed) of every job."""
    return [
        (r, c, scene, views, seed)
        for r in range(len(spec.rows))
        for c, column in enumerate(spec.columns)
        for scene in column.scenes
        for views in column.views
        for seed in spec.seeds
    ]


def make_record(values, **more):
    """run.json with these metrics."""
    test = {name: value for name, value in values.items() if name != "train_s"}
    return {"metrics": {"test": test}, "timing": {"train_s": values.get("train_s", 60.0)}, **more}


def make_results(spec, seed=0, statuses=("finished",), folder=Path("/nowhere")):
    """Outcomes from a seed of Python's random numbers."""
    draw = random.Random(seed)
    outcomes = {}
    for i, place in enumerate(list_places(spec)):
        status = draw.choice(statuses)
        values = {"psnr": draw.uniform(10, 30), "ssim": draw.uniform(0.7, 1), "lpips": draw.uniform(0, 0.3)}
        values |= {"chamfer_sym": draw.uniform(0, 2), "train_s": draw.uniform(30, 300)}
        outcomes[Job(*place, run_dir=folder / f"run{i}")] = Outcome(
            status,
            make_record(values) if status == "finished" else None,
            "it <broke> & stopped" if status == "failed" else None,
        )
    return Results(spec, outcomes)


@st.composite
def tables(draw, statuses=STATUSES):
    """Small tables with all kinds of outcomes; values on a coarse grid, so that there are ties."""
    spec = make_spec(
        rows=draw(st.integers(1, 4)),
        columns=draw(st.integers(1, 2)),
        scenes=draw(st.integers(1, 3)),
        views=tuple(draw(st.permutations([4, 6, 9]))[: draw(st.integers(1, 2))]),
        seeds=tuple(range(draw(st.integers(1, 3)))),
        layout={"mean": draw(st.booleans()), "best": draw(st.sampled_from(["column", "group"]))},
    )
    number = st.one_of(st.integers(10, 14).map(float), st.floats(5, 40), st.none())
    outcomes = {}
    for place in list_places(spec):
        status = draw(st.sampled_from(statuses))
        record = make_record({"psnr": draw(number), "ssim": draw(st.floats(0, 1))})
        outcomes[Job(*place)] = Outcome(status, record if status == "finished" else None)
    return Results(spec, outcomes)
