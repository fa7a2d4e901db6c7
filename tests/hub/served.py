"""A hub on this machine: as much of its HTTP interface as ``huggingface_hub`` needs to list, download and upload."""

import base64
import hashlib
import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote, urlsplit

LARGE = (".safetensors", ".onnx", ".ckpt")
"""Ends of the names of files that are uploaded by git-lfs' interface; the others are in the commit itself."""
_NAME = r"(?:models/)?((?:datasets/)?[^/]+/[^/]+)"
"""Of a repository, after ``/api/``: of a data set it begins with ``datasets/``, as on the command line."""


class Hub:
    """Repositories in memory: commits by repository, the newest last, each with content by path.

    Attributes:
        commits: commit and files, by repository.
        asked: paths of all requests.
        private: repositories that were made so.
        without_lists: whether the files of a repository are not listed, as if the network failed then.
        url: of the server.
    """

    def __init__(self) -> None:
        self.commits: dict[str, list[tuple[str, dict[str, bytes]]]] = {}
        self.asked: list[str] = []
        self.large: dict[str, bytes] = {}
        self.private: set[str] = set()
        self.without_lists = False
        self.url = ""

    def commit(self, repository: str, files: dict[str, bytes]) -> str:
        """Add a commit with exactly these files; its number."""
        known = self.commits.setdefault(repository, [])
        number = hashlib.sha1(f"{repository} {len(known)}".encode()).hexdigest()
        known.append((number, dict(files)))
        return number

    def find(self, repository: str, revision: str) -> tuple[str, dict[str, bytes]]:
        """The commit of a revision: ``main``, or a commit. KeyError where there is none."""
        known = self.commits[repository]
        if revision == "main":
            return known[-1] if known else ("0" * 40, {})
        return next(each for each in known if each[0] == revision)

    def downloaded(self) -> set[str]:
        """Paths of the files that were asked for."""
        file = re.compile(r"[^/]+ /(?:datasets/)?[^/]+/[^/]+/resolve/[^/]+/(.+)")
        return {unquote(m[1]) for each in self.asked if (m := file.match(each))}


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    hub: Hub

    def log_message(self, *_: Any) -> None:
        pass

    def _answer(self, content: bytes | dict[str, Any] | list[Any], status: int = 200, **headers: str) -> None:
        body = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        for name, value in {"Content-Length": str(len(body)), **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def _missing(self, code: str) -> None:
        self._answer({"error": code}, 404, X_Error_Code=code, X_Error_Message=code)

    def _body(self) -> bytes:
        return self.rfile.read(int(self.headers.get("Content-Length") or 0))

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        path = urlsplit(self.path).path
        self.hub.asked.append(f"{self.command} {path}")
        try:
            if m := re.fullmatch(rf"/api/{_NAME}(?:/revision/([^/]+))?", path):
                commit, files = self.hub.find(m[1], unquote(m[2] or "main"))
                siblings = [{"rfilename": name} for name in files]
                private = m[1] in self.hub.private
                self._answer({"id": m[1], "sha": commit, "siblings": siblings, "tags": [], "private": private})
            elif m := re.fullmatch(rf"/api/{_NAME}/tree/([^/]+)/?", path):
                commit, files = self.hub.find(m[1], unquote(m[2]))
                if self.hub.without_lists:
                    self._answer(b"", 404)
                    return
                self._answer([_entry(name, content) for name, content in files.items()])
            elif m := re.fullmatch(r"/((?:datasets/)?[^/]+/[^/]+)/resolve/([^/]+)/(.+)", path):
                commit, files = self.hub.find(m[1], unquote(m[2]))
                content = files.get(unquote(m[3]))
                if content is None:
                    self._missing("EntryNotFound")
                else:
                    etag = f'"{_oid(content)}"'
                    self._answer(content, ETag=etag, X_Repo_Commit=commit, Accept_Ranges="bytes")
            else:
                self._missing("RepoNotFound")
        except KeyError:
            self._missing("RepoNotFound")
        except StopIteration:
            self._missing("RevisionNotFound")

    def do_PUT(self) -> None:
        content = self._body()
        self.hub.large[self.path.rpartition("/")[2]] = content
        self._answer(b"")

    def do_POST(self) -> None:
        path, body = urlsplit(self.path).path, self._body()
        self.hub.asked.append(f"POST {path}")
        if path == "/api/repos/create":
            asked = json.loads(body)
            name = "/".join(filter(None, (asked.get("organization"), asked["name"])))
            if name not in self.hub.commits and (asked.get("private") or asked.get("visibility") == "private"):
                self.hub.private.add(name)
            self.hub.commits.setdefault(name, [])
            self._answer({"url": f"{self.hub.url}/{name}", "name": name, "id": name})
        elif path == "/api/validate-yaml":
            self._answer({"errors": [], "warnings": []})
        elif m := re.fullmatch(r"/api/models/([^/]+/[^/]+)/preupload/main", path):
            files = [each["path"] for each in json.loads(body)["files"]]
            modes = [{"path": f, "uploadMode": "lfs" if f.endswith(LARGE) else "regular"} for f in files]
            self._answer({"files": [{**each, "shouldIgnore": False} for each in modes]})
        elif path.endswith("/info/lfs/objects/batch"):
            objects = [
                {**each, "actions": {"upload": {"href": f"{self.hub.url}/large/{each['oid']}"}}}
                for each in json.loads(body)["objects"]
            ]
            self._answer({"transfer": "basic", "objects": objects})
        elif m := re.fullmatch(r"/api/models/([^/]+/[^/]+)/commit/main", path):
            self._commit(m[1], [json.loads(line) for line in body.splitlines()])
        else:
            self._missing("EntryNotFound")

    def _commit(self, repository: str, lines: list[dict[str, Any]]) -> None:
        files = dict(self.hub.find(repository, "main")[1])
        for line in lines:
            value = line["value"]
            if line["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                files[value["path"]] = self.hub.large[value["oid"]]
        number = self.hub.commit(repository, files)
        self._answer({"commitUrl": f"{self.hub.url}/{repository}/commit/{number}", "commitOid": number})


def _oid(content: bytes) -> str:
    return hashlib.sha1(content).hexdigest()


def _entry(name: str, content: bytes) -> dict[str, Any]:
    return {"type": "file", "oid": _oid(content), "size": len(content), "path": name}


@contextmanager
def serving() -> Iterator[Hub]:
    """An empty hub; it is gone after the block."""
    hub = Hub()
    handler = type("Handler", (_Handler,), {"hub": hub})
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        server.daemon_threads = True
        hub.url = f"http://127.0.0.1:{server.server_port}"
        thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        try:
            yield hub
        finally:
            server.shutdown()
            thread.join()
