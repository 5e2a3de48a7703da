"""Generated tables in a page, between two marks."""

from pathlib import Path

from cutting_trainer.session.errors import SessionError


def page_in(folder: Path, name: str) -> Path:
    """Return the page of a folder that tables go into.

    Raises:
        SessionError: it is not there.
    """
    page = folder / name
    if not page.is_file():
        raise SessionError(f'{page} is not there: the tables go into it')
    return page


def put_table(page: Path, name: str, lines: list[str]) -> None:
    """Replace the text between `<!-- name -->` and `<!-- end of name -->`.

    Raises:
        SessionError: the page has no such marks.
    """
    text = page.read_text(encoding='utf-8')
    start, end = f'<!-- {name} -->', f'<!-- end of {name} -->'
    if start not in text or end not in text:
        raise SessionError(f'{page} has no marks {start} and {end}: the table goes between them')
    before, after = text.split(start)[0], text.split(end)[1]
    table = '\n'.join(lines)
    page.write_text(f'{before}{start}\n\n{table}\n\n{end}{after}', encoding='utf-8')
