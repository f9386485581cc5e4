"""Checks the markup of pages."""

from html.parser import HTMLParser

VOID = {"br", "img", "meta"}
"""Elements of HTML without an end tag. Those of SVG end with `/>`."""


class _Checker(HTMLParser):
    def __init__(self):
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.ids += [values["id"]] if "id" in values else []
        self.links += [values["href"]] if "href" in values else []
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag, f"</{tag}> closes another element"


def check_markup(html: str) -> None:
    """Check that all elements are closed in order, ids are unique, and links within the page lead somewhere."""
    checker = _Checker()
    checker.feed(html)
    checker.close()
    assert checker.open == []
    assert len(checker.ids) == len(set(checker.ids))
    for link in checker.links:
        assert not link.startswith("#") or link[1:] in checker.ids, link
