"""The method under test as a fixture, one after the other."""

from __future__ import annotations

import pytest

from visdom_plugin import registry
from visdom_plugin.conformance.subject import Subject
from visdom_plugin.errors import PluginError
from visdom_plugin.specs import check_requirements


def pytest_generate_tests(metafunc) -> None:
    if "subject" not in metafunc.fixturenames:
        return
    known = registry.installed()
    subjects = [Subject(known, name) for name in metafunc.config.getoption("visdom_methods")]
    metafunc.parametrize("subject", subjects, ids=lambda s: s.name, scope="session")


@pytest.fixture(autouse=True)
def requirements(request):
    """Skips the checks of a method that lacks something from outside, such as weights."""
    if "subject" in request.fixturenames:
        subject = request.getfixturevalue("subject")
        try:
            check_requirements(subject.config)
        except PluginError as error:
            pytest.skip(f"{subject.name} cannot be trained here: {error.what}")


@pytest.fixture
def hooked(subject):
    """The method, where it takes a hook."""
    if subject.hooked is None:
        pytest.skip(f"{subject.name} takes no hook: it has no variant +vd")
    return subject


@pytest.fixture
def sampler(hooked):
    """The method, where its hook bounds rays."""
    if hooked.hook != "sampler":
        pytest.skip(f"the hook of {hooked.name} bounds no rays")
    return hooked


@pytest.fixture
def gaussian(hooked):
    """The method, where its hook looks after Gaussians."""
    if hooked.hook != "gaussian":
        pytest.skip(f"the hook of {hooked.name} is not about Gaussians")
    return hooked
