"""Parts of a page that is one file: its frame, pictures and tables."""

import base64
import io
from collections.abc import Sequence
from html import escape

from matplotlib.figure import Figure

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>
body {{font: 16px/1.45 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem;
  color: #222}}
h1 {{font-size: 1.5rem}} h2 {{font-size: 1.15rem; margin-top: 2rem}}
table {{border-collapse: collapse}}
td, th {{padding: .15rem .8rem .15rem 0; text-align: left; border-bottom: 1px solid #ddd}}
td + td, th + th {{text-align: right}} img {{max-width: 100%}}
figcaption, .note {{color: #555; font-size: .9rem}} figure {{margin: 1rem 0}}
</style></head><body>
{body}
</body></html>
"""


def page(title: str, body: str) -> str:
    """Return a page.

    Args:
        title: plain text.
        body: HTML.
    """
    return _PAGE.format(title=escape(title), body=body)


def image(figure: Figure, caption: str) -> str:
    """Return a picture with its caption, as HTML."""
    out = io.BytesIO()
    figure.savefig(out, format='png', dpi=110)
    text = base64.b64encode(out.getvalue()).decode()
    said = escape(caption)
    return (
        f'<figure><img alt="{said}" src="data:image/png;base64,{text}">'
        f'<figcaption>{said}</figcaption></figure>'
    )


def table(rows: Sequence[Sequence[str]], head: Sequence[str] = ()) -> str:
    """Return a table of plain texts, as HTML."""
    lines = [f'<tr>{"".join(f"<th>{escape(cell)}</th>" for cell in head)}</tr>'] if head else []
    lines += [f'<tr>{"".join(f"<td>{escape(cell)}</td>" for cell in row)}</tr>' for row in rows]
    return f'<table>{"".join(lines)}</table>'
