"""A page as a PDF, by WeasyPrint: print rules of the page's own style sheet, no browser, no network."""

from __future__ import annotations

import importlib
import logging
from typing import Any

from thermostand.foundation.errors import ConfigError


def pdf_of(html: str) -> bytes:
    """ConfigError when WeasyPrint, or the text library it draws with, is not installed."""
    try:
        weasyprint: Any = importlib.import_module("weasyprint")
    except (ImportError, OSError) as error:
        raise ConfigError(
            f"a PDF needs WeasyPrint and Pango ({error}): pip install 'thermostand[pdf]', and on Debian "
            "apt install libpango-1.0-0 libpangoft2-1.0-0; or write .html and print it"
        ) from error
    # It reads figures' styles twice, once as if they were HTML's, and warns of each property.
    logging.getLogger("weasyprint").setLevel(logging.ERROR)
    # Nothing outside of the page is looked up: it has everything in it.
    return bytes(weasyprint.HTML(string=html, url_fetcher=_refused).write_pdf())


def _refused(url: str, *_: object, **__: object) -> Any:
    if url.startswith("data:"):
        fetch: Any = importlib.import_module("weasyprint.urls").default_url_fetcher
        return fetch(url)
    raise ValueError(f"{url[:80]}: a page refers to nothing outside of itself")
