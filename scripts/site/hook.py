"""What mkdocs calls as it builds the site: adds the pages that are made, turns links that lead out of docs/."""

from __future__ import annotations

import re

import commands
import messages
import root_pages
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages."""
    made = {place: root_pages.read_page(source) for source, place in root_pages.PAGES.items()}
    made |= {
        "examples.md": root_pages.show_examples(),
        "commands.md": commands.make_page(),
        "messages.md": messages.make_page(),
    }
    for place, text in made.items():
        files.append(File.generated(config, place, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turns the links of a page of docs/; the contents of a page of wide tables come before its text."""
    place = page.file.src_uri
    text = markdown if page.file.generated_by else root_pages.relink(markdown, f"docs/{place}", place)
    if not is_measured(place):
        return text
    page.meta["hide"] = ["toc"]
    head, first, rest = text.partition("\n## ")
    made = f"{head}\n[TOC]\n{first}{rest}".replace(" ± ", "\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}")
    return re.sub(
        r"^\|.*", lambda row: re.sub(r"(\de-)(\d)", "\\1\N{WORD JOINER}\\2", row[0]), made, flags=re.M
    )


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Names the pages of measurements for the style sheet."""
    return f'<div class="measured">{html}</div>' if is_measured(page.file.src_uri) else html


def is_measured(place: str) -> bool:
    """Whether a page of the site is one of wide tables."""
    return place == "gpu.md" or (place.startswith("findings/") and place != "findings/index.md")
