"""Settings out of range are refused by name, before anything is built."""

from __future__ import annotations

from visdom_plugin.errors import ConfigError


def demand(config: object, conditions: dict[str, tuple[bool, str]], within: str = "") -> None:
    """Refuses a config dataclass with a setting out of range.

    Args:
        conditions: by setting's name, whether it is in range, and the range.
        within: the option whose part the config is, such as "repair".

    Raises:
        ConfigError: naming the first one that is not.
    """
    for name, (holds, allowed) in conditions.items():
        if not holds:
            option = ".".join(filter(None, (within, name))).replace("_", "-")
            raise ConfigError(
                f"{name} = {getattr(config, name)} is out of range",
                where=f"{type(config).__name__}, --method.{option}",
                todo=f"choose {allowed}",
            )
