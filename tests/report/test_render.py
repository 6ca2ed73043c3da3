"""A document as one HTML file, and the words that it explains where they first occur."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
import pytest
from report_page import Page

from omnibench.errors import DataError
from omnibench.report import blocks
from omnibench.report.render import Glossary, render, write_document
from omnibench.report.style import plot

HOSTILE = "</script><script>alert('x')</script><img src=x onerror=alert(1)> & \"quoted\""


class Reader(HTMLParser):
    """Counts tags and keeps the text outside scripts and styles."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: dict[str, str] = {}
        self.text = ""
        self._inside: list[str] = []
        self._script = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag in ("script", "style"):
            self._inside.append(tag)
            self._script = dict(attrs).get("id") or ""

    def handle_endtag(self, tag: str) -> None:
        if tag in ("script", "style"):
            self._inside.pop()

    def handle_data(self, data: str) -> None:
        if not self._inside:
            self.text += data
        elif self._script:
            self.scripts[self._script] = self.scripts.get(self._script, "") + data


def document(*parts: blocks.Block, title: str = "A report") -> blocks.Document:
    return blocks.Document(
        title, "of something", (blocks.Section("part", "A part", parts),), (blocks.Badge("SIMULATED DATA", "warning"),)
    )


def grid(name: str = "curve", values: tuple[float, ...] = (1.0, 2.0)) -> blocks.FigureGrid:
    curve = go.Scatter(x=[0, 1], y=list(values), name=name, legendgroup="one")
    return blocks.FigureGrid((blocks.Figure(name, plot(curve), name),), (blocks.LegendItem("one", name, "#0072b2"),))


def every_block(words: str) -> tuple[blocks.Block, ...]:
    """One block of each kind, all of them made of the same words."""
    table = blocks.Table(
        words,
        (blocks.Column(words, words),),
        (blocks.Row((blocks.Cell(words, words, "#0072b2"),)), blocks.Row((blocks.Cell(words),), "group")),
    )
    inner: tuple[blocks.Block, ...] = (
        blocks.Paragraph(words),
        blocks.Callout(words, (words,)),
        blocks.Facts((blocks.Fact(words, words, words),)),
        table,
    )
    return (*inner, blocks.Code(words, words), blocks.Details(words, inner), grid(words))


def test_hostile_words_stay_words_in_every_block() -> None:
    plain, hostile = (Reader(render(document(*every_block(w), title=w))) for w in ("plain", HOSTILE))
    assert [tag for tag, _ in hostile.tags] == [tag for tag, _ in plain.tags]
    assert hostile.text.count(HOSTILE) >= 15


def test_hostile_words_come_back_whole_from_a_plots_data() -> None:
    reader = Reader(render(document(grid(HOSTILE))))
    assert json.loads(reader.scripts["part-1-1"])["data"][0]["name"] == HOSTILE


def test_the_file_loads_nothing_from_elsewhere() -> None:
    reader = Reader(render(document(*every_block("plain"))))
    sources = [value for _, attrs in reader.tags for name, value in attrs.items() if name in ("src", "href")]
    assert all(value is not None and value.startswith(("#", "data:")) for value in sources)
    policies = [attrs["content"] for _, attrs in reader.tags if attrs.get("http-equiv") == "Content-Security-Policy"]
    assert policies
    assert "default-src 'none'" in (policies[0] or "")


def test_plotly_is_embedded_once_however_many_plots_there_are() -> None:
    html = render(document(grid(), grid(), grid()))
    assert len(re.findall(r"plotly\.js v\d", html)) == 1


def test_every_plot_has_data_of_its_own() -> None:
    reader = Reader(render(document(grid("a"), blocks.Details("more", (grid("b"),)))))
    wanted = [attrs["data-source"] for tag, attrs in reader.tags if tag == "div" and "data-source" in attrs]
    assert len(wanted) == len(set(wanted)) == 2
    assert set(wanted) == set(reader.scripts)


def test_missing_values_of_a_plot_are_valid_json() -> None:
    reader = Reader(render(document(grid(values=(np.nan, np.inf)))))
    assert json.loads(reader.scripts["part-1-1"])["data"][0]["y"] == [None, None]


def test_the_table_of_contents_leads_to_every_section() -> None:
    inner = blocks.Section("inner", "Inner", (blocks.Paragraph("text"),))
    reader = Reader(render(blocks.Document("t", "s", (blocks.Section("outer", "Outer", (), (inner,)),))))
    links = [attrs["href"] for tag, attrs in reader.tags if tag == "a"]
    assert links == ["#outer", "#inner"]
    assert {attrs.get("id") for tag, attrs in reader.tags if tag == "section"} == {"outer", "inner"}


def test_a_report_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(DataError, match=r"report\.html: cannot be written"):
        write_document(document(blocks.Paragraph("text")), tmp_path / "file" / "report.html")


def test_a_written_report_is_what_was_rendered(tmp_path: Path) -> None:
    write_document(document(blocks.Paragraph("text")), tmp_path / "deep" / "report.html")
    assert (tmp_path / "deep" / "report.html").read_text(encoding="utf-8") == render(document(blocks.Paragraph("text")))


def test_a_word_is_explained_where_it_first_occurs_and_only_there() -> None:
    glossary = Glossary()
    assert glossary.marked("the held-out error").startswith('the <dfn title="runs that the fit has not seen')
    assert glossary.marked("held out again") == "held out again"
    assert [word for word, _ in glossary.fresh()] == ["held out"]
    assert glossary.fresh() == []


def test_a_part_of_a_word_is_not_marked() -> None:
    assert Glossary().marked("costly boxes, preference") == "costly boxes, preference"


def test_hostile_words_stay_words() -> None:
    marked = Glossary().marked("<b>cost</b> & <i>")
    assert marked.startswith("&lt;b&gt;<dfn ")
    assert marked.endswith("</dfn>&lt;/b&gt; &amp; &lt;i&gt;")


def test_the_meanings_stand_below_the_section_that_first_uses_the_words() -> None:
    sections = (
        blocks.Section("a", "One", (blocks.Paragraph("The cost fell."),)),
        blocks.Section("b", "Two", (blocks.Paragraph("The cost rose."),)),
    )
    html = render(blocks.Document("t", "s", sections))
    assert html.count("<dfn ") == 1
    told = Page(html).text
    assert told.index("The cost fell.") < told.index("what a calibration makes small") < told.index("The cost rose.")


def test_a_word_of_several_meanings_is_explained_where_it_has_the_one_that_is_listed() -> None:
    glossary = Glossary()
    assert "<dfn" not in glossary.marked("cannot fall below the bound; the weights of x and y")
    glossary.marked("98 % of the bound that no design exceeds; weight of 95 %")
    assert [word for word, _ in glossary.fresh()] == ["bound", "weight"]
