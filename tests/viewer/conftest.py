from tests.cli.conftest import fakes

__all__ = ["fakes"]
