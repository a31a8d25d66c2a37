"""The page of a scene as its reader meets it: tables, buttons, scripts."""

from html.parser import HTMLParser


class Page(HTMLParser):
    """Tables as rows of text, buttons of objects, scripts; every tag opened must be closed."""

    VOID = ("meta", "input", "br")

    def __init__(self, page: str) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.buttons: dict[str, str] = {}
        self.scripts: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.button = ""
        self.feed(page)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag == "script":
            self.scripts.append("")
        if tag == "button" and (name := dict(attrs).get("data-id")):
            self.button = name
            self.buttons[name] = ""

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag
        if tag == "button":
            self.button = ""

    def handle_data(self, data):
        if "td" in self.open or "th" in self.open:
            self.rows[-1][-1] += data
        if self.button:
            self.buttons[self.button] += data + "|"
        if "script" in self.open:
            self.scripts[-1] += data
