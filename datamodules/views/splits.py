"""Which views train and which test: lists given by hand, index files, the layout's own, or evenly spread.

Positions are zero-based in the list of all views of the scene, in the layout's order (sorted by name).
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from datamodules.capture import Pools
from datamodules.files.paths import read_inside
from datamodules.request import Request
from datamodules.views.view_lists import is_integer, read_list
from visdom_plugin.errors import SceneError, list_some

log = logging.getLogger(__name__)

DEFAULT_VIEWS = 4
ALL = "all"
"""In place of a list by hand: every view trains that is not listed for testing."""
_LISTED = 16
"""Longest list of views that an error spells out."""


@dataclass(frozen=True)
class Split:
    """Positions of the views of one request."""

    train: list[int]
    test: list[int]
    hashes: dict[str, str]
    """SHA-256 of each index file read, by its name."""
    rule: str
    """How the views were chosen, for people."""
    free: tuple[int, ...] = ()
    """Of views spread evenly: all that they were spread over."""
    all_train: bool = False
    """Whether views train that are for testing where fewer are asked for."""


def every_eighth(positions: Sequence[int]) -> Pools:
    """The standard split of MipNeRF360: of some positions every 8th from the first on is for testing."""
    test = tuple(positions[::8]) if len(positions) > 1 else ()
    return Pools(tuple(i for i in positions if i not in test), test, "every 8th view is for testing")


def pick_evenly(pool: Sequence[int], count: int) -> list[int]:
    """`count` members of `pool`, the first and the last among them, at even steps (halves rounded up)."""
    if count == 1:
        return [pool[0]]
    last, steps = len(pool) - 1, count - 1
    return [pool[(2 * i * last + steps) // (2 * steps)] for i in range(count)]


def choose(
    root: Path, names: Sequence[str], request: Request, pools: Pools, *, indexed: bool = False
) -> Split:
    """The views of a request.

    Args:
        root: the scene's folder, where index files may lie.
        names: of all views, in the layout's order.
        pools: the layout's own split, for what nobody lists.
        indexed: the layout demands index files.

    Raises:
        SceneError: an index file is missing, is not integers, is out of range, repeats itself, has another
            length than its name says, or shares a view with the other; too few views.
        ConfigError: the same of a list given by hand.
    """
    count, hashes, rules, all_train = len(names), {}, [], False
    train = held = None
    train_where, test_where = "--train-list", "--test-list"
    files = _index_files(root)
    if request.train_list == ALL:
        rules.append("all views train but those listed for testing")
    elif request.train_list is not None:
        train = read_list(request.train_list, names, train_where)
        rules.append("training views as listed by hand")
        if request.views not in (None, len(train)):
            log.info("%s lists %d views; --views %d is ignored", train_where, len(train), request.views)
    elif indexed or files:
        views = min(files, default=None) if request.views is None else request.views
        if views in files:
            train_where = f"sparse_{views}.txt"
            train, hashes[train_where] = _read(root, train_where, count, request.allow_outside)
            _check_length(root, train_where, train, views)
            rules.append(f"training views of {train_where}")
        elif indexed:
            _no_index_file(root, views, sorted(files), _spread_by_hand(root, count, views, request))
    if not request.test and train is not None:
        held = []
    elif request.test_list is not None:
        held = read_list(request.test_list, names, test_where)
    elif (root / "sparse_test.txt").is_file() or (indexed and request.test):
        test_where = "sparse_test.txt"
        if not (root / test_where).is_file():
            raise SceneError(
                "sparse_test.txt is missing",
                where=root,
                todo="write the zero-based positions of the views to test on into it, one per line",
                topic="which-views",
            )
        held, hashes[test_where] = _read(root, test_where, count, request.allow_outside)
    listed = held is not None
    if held is None:
        taken = set(train or ())
        held = [i for i in pools.test if i not in taken] if request.hold_out else []
        unused = count - len(taken) - len(held)
        if train is not None and unused and request.train_list is not None and request.hold_out:
            said = "%s: %d views neither train nor test (%s); --test-list names others to test on"
            log.info(said, root, unused, pools.rule)
        rules.append(pools.rule if request.hold_out else "no view is held out")
    if train is None:
        # Test views stay out of training even when nobody asks for them: --views N means the same everywhere.
        every = [i for i in sorted({*pools.train, *pools.test}) if not (listed and i in held)]
        wanted = DEFAULT_VIEWS if request.views is None else request.views
        if every and (request.train_list == ALL or len(every) <= wanted):
            if request.train_list != ALL:
                rules = [f"all {len(every)} views train, there are no more than the {wanted} wanted"]
                log.info("%s: %s", root, rules[0])
            tested = held if listed and request.test else []
            return Split(every, tested, hashes, "; ".join(rules), all_train=request.train_list != ALL)
        pool = [i for i in pools.train if i not in held] if request.hold_out else every
        if not request.test and request.hold_out and len(pool) < (request.views or 1) <= len(every):
            log.info(
                "%s: %d views are all but those for testing, so these are taken as well", root, len(pool)
            )
            pool, rules, all_train = every, [*rules[:-1], "no view is held out"], True
        train, rule = _pick_training(root, names, pool, every, request.views)
        rules.append(rule)
        free = tuple(pool)
    else:
        free = ()
    tested = held if request.test else []
    _refuse_shared(train, tested, f"{train_where} and {test_where}", root)
    return Split(train, tested, hashes, "; ".join(rules), free, all_train)


def _pick_training(
    root: Path, names: Sequence[str], pool: list[int], every: list[int], views: int | None
) -> tuple[list[int], str]:
    """Views of the pool, and the rule in words; `every` holds those that could be listed by hand."""
    wanted = min(DEFAULT_VIEWS, len(pool)) if views is None else views
    if not pool or not 1 <= wanted <= len(pool):
        todo = f"pass --views with 1 to {len(pool)}" if pool else "choose by hand with --train-list"
        if len(pool) < wanted <= min(len(every), _LISTED):
            by_hand = ",".join(map(str, pick_evenly(every, wanted)))
            todo += f"; or train on views that are for testing, too: --train-list {by_hand}"
            if wanted == len(names):
                todo += " (where no view is left to test on, visdom-eval --leave-one-out measures)"
        elif pool:
            todo += ", or choose by hand with --train-list and --test-list"
        raise SceneError(
            f"{wanted} training views are wanted, but {len(pool)} of the {len(names)} views are for training",
            where=root,
            todo=todo,
            topic="which-views",
        )
    train = pick_evenly(pool, wanted)
    log.info(
        "%s: nothing lists %d training views; they are spread evenly over the %d not held out for testing: %s",
        root,
        wanted,
        len(pool),
        list_some((names[i] for i in train), 12),
    )
    return train, f"training views spread evenly over the {len(pool)} others"


def _refuse_shared(train: list[int], tested: list[int], where: str, root: Path) -> None:
    shared = sorted(set(train) & set(tested))
    if shared:
        raise SceneError(
            f"training and test share views {list_some(shared, 8)}",
            where=f"{root}: {where}",
            cause="a test on views that were trained on measures nothing",
            todo=f"take them out of {where.split(' and ')[1]}",
            topic="which-views",
        )


def _index_files(root: Path) -> set[int]:
    stems = (path.stem.removeprefix("sparse_") for path in root.glob("sparse_*.txt"))
    return {int(stem) for stem in stems if stem.isascii() and stem.isdecimal() and len(stem) < 7}


def _no_index_file(root: Path, views: int | None, available: list[int], by_hand: str | None) -> None:
    listed = ", ".join(map(str, available))
    other = f"; or choose by hand, spread evenly for example: --train-list {by_hand}" if by_hand else ""
    raise SceneError(
        f"there is no sparse_{'<N>' if views is None else views}.txt, the list of that many training views"
        + (f"; this scene has such index files for {listed} views" if available else ""),
        where=root,
        todo=f"pass --views with one of {listed}{other}"
        if available
        else f"write the zero-based positions of the training views, one per line, into sparse_<N>.txt{other}",
        topic="which-views",
    )


def _spread_by_hand(root: Path, count: int, views: int | None, request: Request) -> str | None:
    """A list of as many views that are not for testing, as `--train-list` takes it; None where there is none."""
    tested: list[int] = []
    if (root / "sparse_test.txt").is_file():
        tested, _ = _read(root, "sparse_test.txt", count, request.allow_outside)
    free = sorted(set(range(count)) - set(tested))
    if views is None or not 1 <= views <= min(len(free), _LISTED):
        return None
    return ",".join(map(str, pick_evenly(free, views)))


def _check_length(root: Path, name: str, train: list[int], views: int) -> None:
    if len(train) != views:
        raise SceneError(
            f"{name} lists {len(train)} views, its name says {views}",
            where=root / name,
            todo="rename the file or correct the list",
            topic="which-views",
        )


def _read(root: Path, name: str, count: int, outside: bool) -> tuple[list[int], str]:
    data = read_inside(root, name, outside=outside, most=2**24)
    return parse_positions(data, count, root / name), hashlib.sha256(data).hexdigest()


def parse_positions(data: bytes, count: int, path: Path) -> list[int]:
    """The positions in an index file, checked against the number of views.

    Raises:
        SceneError: for anything but at least one integer in [0, count), none of them twice.
    """
    name = path.name
    words = data.decode("utf-8-sig", errors="replace").replace(",", " ").split()
    for word in words:
        if not is_integer(word):
            raise SceneError(
                f"{name} holds {word[:40]!r}, which is not an integer",
                where=path,
                todo="write zero-based positions in the name-sorted list of images, not file names",
                topic="which-views",
            )
    positions = [int(word) for word in words]
    if not positions:
        raise SceneError(
            f"{name} lists no views", where=path, todo="write one position per line", topic="which-views"
        )
    outside = [p for p in positions if not 0 <= p < count]
    if outside:
        raise SceneError(
            f"{name} lists position {outside[0]}, but the {count} registered images have 0 to {count - 1}",
            where=path,
            cause="positions counted from 1, or a list made for another model" if outside[0] >= 0 else None,
            todo="write zero-based positions in the name-sorted list of registered images",
            topic="which-views",
        )
    seen: set[int] = set()
    for p in positions:
        if p in seen:
            raise SceneError(
                f"{name} lists position {p} twice",
                where=path,
                todo="list each view once",
                topic="which-views",
            )
        seen.add(p)
    return positions
