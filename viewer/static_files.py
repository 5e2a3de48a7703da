"""Static files of the page, and the HTTP headers of every response."""

from pathlib import Path

from websockets.datastructures import Headers
from websockets.http11 import Response

FOLDER = Path(__file__).with_name('static')
_TYPES = {
    '.css': 'text/css; charset=utf-8',
    '.html': 'text/html; charset=utf-8',
    '.ico': 'image/x-icon',
    '.js': 'text/javascript; charset=utf-8',
    '.json': 'application/json',
    '.mjs': 'text/javascript; charset=utf-8',
    '.png': 'image/png',
    '.svg': 'image/svg+xml',
    '.txt': 'text/plain; charset=utf-8',
    '.webmanifest': 'application/manifest+json',
    '.woff2': 'font/woff2',
}
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self' ws://{host} wss://{host}; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
_PHRASES = {200: 'OK', 403: 'Forbidden', 404: 'Not Found', 503: 'Service Unavailable'}


def read_files(folder: Path = FOLDER) -> dict[str, tuple[str, bytes]]:
    """Return type and content of every file of the page by its path: only these are served.

    Args:
        folder: of the files.
    """
    files = {
        f'/static/{path.relative_to(folder).as_posix()}': (_TYPES[path.suffix], path.read_bytes())
        for path in sorted(folder.rglob('*'))
        if path.is_file() and path.suffix in _TYPES
    }
    if '/static/index.html' in files:
        files['/'] = files['/instructor'] = files['/static/index.html']
    return files


def answer(status: int, host: str, content: tuple[str, bytes] | None = None) -> Response:
    """Return a response whose headers restrict a page to its own files.

    Args:
        status: of HTTP.
        host: host name of the request; known to the gate.
        content: type and bytes; None: a sentence about the status.
    """
    kind, body = content or (_TYPES['.txt'], f'{_PHRASES[status]}\n'.encode())
    headers = Headers()
    for name, value in (
        ('Content-Type', kind),
        ('Content-Length', str(len(body))),
        ('Content-Security-Policy', _POLICY.format(host=host)),
        ('X-Content-Type-Options', 'nosniff'),
        ('X-Frame-Options', 'DENY'),
        ('Referrer-Policy', 'no-referrer'),
        ('Cross-Origin-Opener-Policy', 'same-origin'),
        ('Cross-Origin-Resource-Policy', 'same-origin'),
        ('Cache-Control', 'no-cache'),
        ('Connection', 'close'),
    ):
        headers[name] = value
    return Response(status, _PHRASES[status], headers, body)
