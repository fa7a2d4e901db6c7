"""What a server asks of those who come: a token, and TLS so that nobody reads it on the way."""

import hashlib
import hmac
import os
import re
import ssl
from dataclasses import dataclass, field
from ipaddress import ip_address
from pathlib import Path

from ttscompile.core.paths import require_path
from ttscompile.errors import ExecutorError

LEAST_CHARACTERS = 22
"""128 random bits in base64: nobody guesses them, however often he may try."""
MOST_BYTES = 4096
TOKEN = re.compile(r"[A-Za-z0-9\-._~+/]+=*")
"""What may stand after ``Bearer`` (RFC 6750)."""
_MAKE = "openssl rand -base64 33"
_GIVEN = re.compile(r"(?:bearer|api-key) +(\S+) *", re.IGNORECASE)  # the latter is openpi's


@dataclass(frozen=True)
class Lock:
    """Who may come in, and from where.

    Attributes:
        token_hash: SHA-256 of the token that clients send, from ``hashed``; None asks for none. The token itself is
            not kept.
        tls: made by ``tls_context``; None leaves connections readable.
        insecure: whether others than programs of this machine may come where a token or TLS is missing.
    """

    token_hash: bytes | None = field(default=None, repr=False)
    tls: ssl.SSLContext | None = None
    insecure: bool = False

    def opens(self, authorization: str | None) -> bool:
        """Whether the header ``Authorization`` of a handshake has the token.

        How long the answer takes says nothing about the token: hashes are compared, in constant time.
        """
        if self.token_hash is None:
            return True
        found = _GIVEN.fullmatch(authorization or "")
        given = hashlib.sha256((found[1] if found else "").encode(errors="replace")).digest()
        return hmac.compare_digest(given, self.token_hash)

    def missing(self) -> str:
        """What a server lacks that others than programs of this machine may reach; empty if it is locked."""
        lacks = (("token", self.token_hash), ("certificate", self.tls))
        return " and ".join(f"no {name}" for name, there in lacks if there is None)

    def require(self, address: str) -> None:
        """Raise ExecutorError for an address that others may reach, unless it is locked or that was asked for."""
        lacks = self.missing()
        if self.insecure or not lacks or ip_address(address).is_loopback:
            return
        raise ExecutorError(
            f"{address} may be reached from other machines, and the server has {lacks}: whoever reaches it could drive"
            " the robot. Give a token and a certificate (--token-file, --tls), listen on 127.0.0.1, or say"
            " --insecure."
        )


def hashed(token: str, where: str) -> bytes:
    """What ``Lock`` keeps of a token.

    Args:
        token: white space around it is left out.
        where: that it is from, for the message, which never shows it.

    Raises:
        ExecutorError: it is short, or has characters that a token may not have.
    """
    token = token.strip()
    if len(token) < LEAST_CHARACTERS or not TOKEN.fullmatch(token):
        expected = f"expected at least {LEAST_CHARACTERS} of the characters A-Z, a-z, 0-9 and -._~+/"
        raise ExecutorError(f"{where}: {expected}, and a token has no others. Make one: {_MAKE}")
    return hashlib.sha256(token.encode()).digest()


def read_token(path: Path) -> str:
    """The text of a file that holds a token and nothing else. Raises ExecutorError: it is no such file."""
    require_path(path, ExecutorError, "Give a file with a token in it.")
    try:
        with path.open("rb") as file:
            content = file.read(MOST_BYTES + 1)
        if len(content) > MOST_BYTES:
            raise ExecutorError(f"{path}: has more than {MOST_BYTES} bytes. Give a file with a token and nothing else.")
        return content.decode("ascii")
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "it is no text of plain letters"
        raise ExecutorError(f"{path}: cannot be read: {why}. Give a file with a token in it.") from error


def read_by_others(path: Path) -> bool:
    """Whether other users of the machine may read a file; Windows does not say."""
    return os.name == "posix" and bool(path.stat().st_mode & 0o077)


def tls_context(certificate: Path, key: Path | None = None) -> ssl.SSLContext:
    """TLS 1.2 or later with this certificate.

    Args:
        certificate: PEM, the server's own first, then those between it and the authority's.
        key: PEM, its private key without a password; None if it is in the file of the certificate.

    Raises:
        ExecutorError: a file cannot be read, is none of these, or the key is that of another certificate.
    """
    for path in (certificate, key or certificate):
        require_path(path, ExecutorError, "Give a file in PEM format.")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(certificate, key, password=lambda: "")  # OpenSSL would ask on the terminal
    except (OSError, ssl.SSLError, ValueError) as error:
        why = getattr(error, "reason", None) or getattr(error, "strerror", None) or error
        names = f"{certificate} and {key}" if key else f"{certificate}"
        expected = "expected a certificate and its private key without a password, in PEM format"
        raise ExecutorError(f"{names}: {why}; {expected}. docs/serve.md has a command that makes them.") from error
    return context
