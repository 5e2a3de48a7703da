"""A hook of MkDocs: links that leave docs/ name the file of the repository instead."""

import re

OUTSIDE = re.compile(r'(?<!!)\[([^\]]+)\]\(\.\./([^)#]+)(?:#[^)]*)?\)')


def on_page_markdown(markdown: str, **_: object) -> str:
    """Return the page with each link to a file outside of docs/ as its text and path."""

    def named(link: re.Match[str]) -> str:
        text, path = link.groups()
        return f'`{path}`' if path.endswith(text) else f'{text} (`{path}`)'

    return OUTSIDE.sub(named, markdown)
