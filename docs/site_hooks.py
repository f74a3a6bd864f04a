"""For mkdocs: links out of docs/ lead to the repository, where those files are."""

from __future__ import annotations

import posixpath
import re
from typing import Any

_LINK = re.compile(r"(\]\()((?:\.\./)+[^)\s]*)(\))")


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Links that climb above docs/ become addresses."""

    def moved(match: re.Match[str]) -> str:
        target, _, anchor = match[2].partition("#")
        path = posixpath.normpath(posixpath.join("docs", posixpath.dirname(page.file.src_uri), target))
        if path.startswith("docs/"):
            return match[0]
        kind = "blob" if posixpath.splitext(path)[1] or path == "LICENSE" else "tree"
        address = f"{config['repo_url']}/{kind}/main/{path}"
        return f"{match[1]}{address}{'#' if anchor else ''}{anchor}{match[3]}"

    return _LINK.sub(moved, markdown)
