"""What every test can count on: it hears the packages' log, whatever ran before it."""

from __future__ import annotations

import logging

import pytest


@pytest.fixture(autouse=True)
def heard():
    """A command with --quiet silences its process; the tests after it want to hear."""
    yield
    for name in ("visdom_plugin", "datamodules", "method_configs"):
        logging.getLogger(name).setLevel(logging.NOTSET)
