"""K has one spelling in all commands, and the older ones do as well."""

import pytest

from visdom_plugin.cli import options
from visdom_plugin.hull.wording import for_commands, wording


@pytest.mark.parametrize("words", [["--k", "2"], ["-k", "2"], ["--k=2"], ["--method.hull.k", "2"]])
def test_training_takes_it_as_the_other_commands_do(words):
    assert options.parse(["method:ingp+vd", *words]).config.hull.k == 2


def test_advice_to_commands_names_options_alone():
    assert wording().set_k.format(k=2) == "VisibleDomain(k=2)" and not wording().poses
    with for_commands():
        assert wording().set_k.format(k=2) == "--k 2" and "visdom-check" in wording().poses
