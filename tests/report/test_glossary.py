"""Words that reports explain where they first occur."""

from __future__ import annotations

from report_page import Page

from omnibench.report.blocks import Document, Paragraph, Section
from omnibench.report.glossary import Glossary
from omnibench.report.render import render


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
        Section("a", "One", (Paragraph("The cost fell."),)),
        Section("b", "Two", (Paragraph("The cost rose."),)),
    )
    html = render(Document("t", "s", sections))
    assert html.count("<dfn ") == 1
    told = Page(html).text
    assert told.index("The cost fell.") < told.index("what a calibration makes small") < told.index("The cost rose.")


def test_a_word_of_several_meanings_is_explained_where_it_has_the_one_that_is_listed() -> None:
    glossary = Glossary()
    assert "<dfn" not in glossary.marked("cannot fall below the bound; the weights of x and y")
    glossary.marked("98 % of the bound that no design exceeds; weight of 95 %")
    assert [word for word, _ in glossary.fresh()] == ["bound", "weight"]
