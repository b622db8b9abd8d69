"""All files of a table: table.md, table.csv, table_scenes.csv, table.tex, table.html."""

from __future__ import annotations

from pathlib import Path

from visdom_plugin.atomic_files import write_bytes
from visdom_plugin.tables.report.summary import summarise
from visdom_plugin.tables.report.write_html import to_html
from visdom_plugin.tables.report.write_text import to_csv, to_latex, to_markdown, to_scene_csv
from visdom_plugin.tables.results import Results


def write_all(results: Results, folder: Path) -> list[Path]:
    """Writes the table's files, each in one step; what they say depends on the results alone.

    Everything is worked out before the first file appears.

    Raises:
        ConfigError: for an unknown metric, layout, or place in the paper.
    """
    folder, spec = Path(folder), results.spec
    summary = summarise(results)
    content = {
        "table.md": to_markdown(spec, summary),
        "table.csv": to_csv(spec, summary),
        "table_scenes.csv": to_scene_csv(spec, summary, folder),
        "table.tex": to_latex(spec, summary),
        "table.html": to_html(spec, summary),
    }
    for name, text in content.items():
        write_bytes(folder / name, text.encode())
    return [folder / name for name in content]
