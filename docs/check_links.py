"""Checks every link inside the built site: the page and the place on it must exist, and nothing is loaded from the network.

python docs/check_links.py build/docs
"""

from __future__ import annotations

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class _Page(HTMLParser):
    """Anchors, links and loaded files of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.anchors |= {value for name in ("id", "name") if (value := given.get(name))}
        if tag == "a" and given.get("href"):
            self.links.append(given["href"] or "")
        for name in {"img": ("src",), "script": ("src",), "link": ("href",)}.get(tag, ()):
            if given.get(name) and given.get("rel") not in ("canonical", "search", "index", "next", "prev"):
                self.loaded.append(given[name] or "")


def broken(site: Path) -> list[str]:
    """What is wrong with the links of a site, one text each."""
    pages = {path: _Page(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}
    out = []
    for path, page in pages.items():
        name = path.relative_to(site)
        for link in (*page.links, *page.loaded):
            parts = urlsplit(link)
            if parts.scheme in ("http", "https", "data", "mailto") or link.startswith("//"):
                if link in page.loaded and parts.scheme != "data":
                    out.append(f"{name} loads {link} from the network")
                continue
            target = path if not parts.path else (path.parent / unquote(parts.path)).resolve()
            if target.is_dir():
                target = target / "index.html"
            if not target.exists():
                out.append(f"{name} points to {link}, which is not there")
            elif parts.fragment and target.resolve() in pages and unquote(parts.fragment) not in pages[target.resolve()].anchors:
                out.append(f"{name} points to {link}, which has no such place")
    return out


def main(site: Path) -> int:
    """Print what is wrong; 1 if anything is, or if there is no page."""
    found = broken(site.resolve())
    if not (site / "index.html").exists():
        found.append(f"{site} holds no index.html")
    print("\n".join(found), file=sys.stderr, end="\n" if found else "")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
