"""The pages that are made with the site tell of all there is, and links lead somewhere."""

from __future__ import annotations

import dataclasses
import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest
from PIL import Image

import sart_toolkit
from sart_toolkit import errors
from sart_toolkit.cli.verbs import VERBS

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


def tool(name: str) -> ModuleType:
    """A program of `tools/` as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


site_pages = tool("site_pages")


@pytest.fixture(scope="module")
def made() -> dict[str, str]:
    pages: dict[str, str] = site_pages.generated_pages()
    return pages


def test_every_flag_of_every_verb_is_in_the_reference(made: dict[str, str]) -> None:
    page = made["reference/command.md"]
    parts = dict(re.findall(r"^## sart ([\w ]+)\n(.*?)(?=^## |\Z)", page, re.M | re.S))
    assert set(parts) == set(VERBS)
    for name, verb in VERBS.items():
        flags = re.findall(r"^\| `(.+?)` \| \S", parts[name], re.M)
        assert len(flags) == len(dataclasses.fields(verb.arguments)), name
        assert f"sart {name}" in parts[name] and verb.summary in parts[name].replace("&#95;", "_")


def test_every_public_name_is_in_the_reference(made: dict[str, str]) -> None:
    text = "".join(page for path, page in made.items() if path.startswith("reference/python/"))
    assert len(sart_toolkit.__all__) > 100
    for name in sart_toolkit.__all__:
        assert f"heading: sart.{name}\n" in text, name


def test_every_error_says_what_to_do_and_which_messages_it_comes_with(made: dict[str, str]) -> None:
    page = made["troubleshooting.md"]
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type)]
    classes = [kind for kind in kinds if issubclass(kind, errors.SartError)]
    assert len(classes) > 10
    for error in classes:
        (part,) = re.findall(rf"^## {error.__name__}\n\n(.*?)(?=^## |\Z)", page, re.M | re.S)
        first, remedy, *_ = part.split("\n\n")
        assert first.endswith(".") and len(remedy) > 20, error
    assert page.count("\n    - ") > 300


def test_what_a_program_says_has_no_meaning_in_markdown() -> None:
    text = site_pages.plain("a|b [x][...] <y> *.h5 $HOME `sart *`")
    assert text.endswith("`sart *`")
    assert not set("|[]<>*$") & set(text.partition("`")[0])


@pytest.mark.parametrize(
    ("page", "asked"),
    [
        ('<script src="https://a.example/x.js"></script>', ["https://a.example/x.js"]),
        ('<link rel="stylesheet" href="//a.example/x.css">', ["//a.example/x.css"]),
        ('<img alt="" src="http://a.example/x.png">', ["http://a.example/x.png"]),
        ('<a href="https://a.example/">read</a><img src="images/x.png">', []),
    ],
)
def test_a_page_that_would_ask_other_servers_is_noticed(page: str, asked: list[str]) -> None:
    assert site_pages.requests_of(page) == asked


def test_links_lead_to_files_and_pages(made: dict[str, str]) -> None:
    sources = {path: path.read_text() for path in (ROOT / "README.md", *DOCS.rglob("*.md"))}
    links = 0
    for path, text in sources.items():
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
            if target.startswith(("https://", "http://")):
                continue
            place = (path.parent / target).resolve()
            generated = place.is_relative_to(DOCS) and str(place.relative_to(DOCS)) in made
            assert place.exists() or generated, f"{path.name}: {target}"
            assert path.name == "README.md" or place.is_relative_to(DOCS), f"{path.name}: {target}"
            links += 1
    assert links > 150


def test_every_page_can_be_found_from_the_others() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text().split("nav:\n")[-1].partition("exclude_docs:")[0]
    for path in DOCS.rglob("*.md"):
        assert re.search(rf"[ ]{path.relative_to(DOCS)}\n", navigation), path


def test_every_equation_has_a_picture_that_its_tool_draws(tmp_path: Path) -> None:
    images = tool("concept_images")
    page = (DOCS / "concepts.md").read_text()
    sections = [part for part in page.split("\n## ") if "$$" in part]
    shown = [re.findall(r"\]\(images/concepts/(\w+)\.png\)", part) for part in sections]
    assert [name for (name,) in shown] == list(images.PICTURES)
    assert all(part.count("$$") == 2 for part in sections)
    assert images.main(["allocation", "interval", "--out", str(tmp_path)]) == 0
    for name in ("allocation", "interval"):
        with Image.open(tmp_path / f"{name}.png") as drawn:
            assert len(drawn.convert("RGB").getcolors(1 << 20)) > 50
