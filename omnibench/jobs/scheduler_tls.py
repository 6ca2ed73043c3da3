"""Files that a client of a scheduler at tls:// needs."""

from __future__ import annotations

from omnibench.config import Model, RelativePath


class TlsFiles(Model):
    """Files in PEM: the authority's certificate, and this client's with its key."""

    ca: RelativePath
    cert: RelativePath
    key: RelativePath
