"""A small stand-in for the Hugging Face hub, on the loopback interface.

It has the parts of the hub's HTTP interface that ``huggingface_hub`` uses to create a model
repository, to commit to it, and to download from it. Repositories are folders below ``--root``,
with one folder for each commit, so they outlast the server. ``--around COMMAND…`` runs a command
with ``HF_ENDPOINT`` and a token for the namespace ``me``.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlparse

WRITER, READER = "hf_writer", "hf_reader"
"""Tokens: of the user ``me``, with and without write access."""
OWNER = "me"
LARGE = (".safetensors", ".mp4", ".gif")
"""Files that clients upload to the large file storage."""


class RefusalError(Exception):
    """An answer that is not a success."""

    def __init__(self, status: int, code: str, message: str, **more: str) -> None:
        self.status, self.code, self.message, self.more = status, code, message, more


class StandIn(ThreadingHTTPServer):
    """The hub, with its repositories in a folder."""

    daemon_threads = True

    def __init__(self, root: Path) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.root = root
        self.lock = threading.Lock()

    @property
    def address(self) -> str:
        """For ``HF_ENDPOINT``."""
        return f"http://127.0.0.1:{self.server_address[1]}"

    def state(self, repo: str) -> dict[str, Any]:
        """Returns a repository's visibility and commits, oldest first."""
        path = self.root / repo / "state.json"
        if not path.is_file():
            raise RefusalError(404, "RepoNotFound", "Repository not found")
        return json.loads(path.read_text())

    def write_state(self, repo: str, state: dict[str, Any]) -> None:
        """Writes a repository's visibility and commits."""
        (self.root / repo / "state.json").write_text(json.dumps(state))

    def commit(self, repo: str, changes: list[dict[str, Any]]) -> str:
        """Adds a commit with changes as a client sends them; returns its id."""
        with self.lock:
            state = self.state(repo)
            made = hashlib.sha1(f"{repo} {len(state['commits'])}".encode()).hexdigest()
            folder = self.root / repo / made
            if state["commits"]:
                shutil.copytree(self.root / repo / state["commits"][-1], folder)
            folder.mkdir(exist_ok=True)
            for change in changes:
                value = change["value"]
                if change["key"] == "file":
                    (folder / value["path"]).write_bytes(base64.b64decode(value["content"]))
                elif change["key"] == "lfsFile":
                    shutil.copy(self.root / "large" / value["oid"], folder / value["path"])
                elif change["key"] == "deletedFile":
                    (folder / value["path"]).unlink()
                else:
                    assert change["key"] == "header", change
            state["commits"].append(made)
            self.write_state(repo, state)
            return made

    def files(self, repo: str, revision: str | None) -> tuple[str, Path | None]:
        """Returns the id of a revision, and the folder with its files."""
        commits = self.state(repo)["commits"]
        if revision in (None, "main"):
            return (commits[-1], self.root / repo / commits[-1]) if commits else ("0" * 40, None)
        if revision not in commits:
            raise RefusalError(404, "RevisionNotFound", f"Invalid rev id: {revision}")
        return revision, self.root / repo / revision


class Handler(BaseHTTPRequestHandler):
    """Answers one client."""

    server: StandIn
    protocol_version = "HTTP/1.1"

    def answer(self) -> None:
        """Answers a request of any method."""
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        path = unquote(urlparse(self.path).path)
        try:
            for method, pattern, reply in ROUTES:
                match = re.fullmatch(pattern, path)
                if match and self.command in method:
                    return reply(self, body, **match.groupdict())
            raise RefusalError(404, "", f"the stand-in lacks {self.command} {path}")
        except RefusalError as refusal:
            headers = {"X-Error-Code": refusal.code, "X-Error-Message": refusal.message}
            body = json.dumps({"error": refusal.message, **refusal.more}).encode()
            self.reply(body, headers, refusal.status)

    do_GET = do_HEAD = do_POST = do_PUT = answer  # noqa: N815

    def reply(self, body: bytes, headers: dict[str, str], status: int = 200) -> None:
        """Sends an answer."""
        self.send_response(status)
        for name, value in {"Content-Length": str(len(body)), **headers}.items():
            if value:
                self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def json(self, value: Any) -> None:
        """Sends an answer in JSON."""
        self.reply(json.dumps(value).encode(), {"Content-Type": "application/json"})

    def check(self, repo: str, *, writes: bool) -> None:
        """Refuses a token that may not read or write."""
        token = self.headers.get("Authorization", "").removeprefix("Bearer ")
        if token and token not in (WRITER, READER):
            raise RefusalError(401, "", "Invalid credentials in Authorization header")
        if writes and (token != WRITER or not repo.startswith(f"{OWNER}/")):
            raise RefusalError(403, "", "You don't have the rights to write to this namespace")
        if not writes and not token and self.server.state(repo)["private"]:
            raise RefusalError(401, "RepoNotFound", "Repository not found")

    def create(self, body: bytes) -> None:
        """Creates a repository."""
        wanted = json.loads(body)
        repo = f"{wanted['organization']}/{wanted['name']}"
        self.check(repo, writes=True)
        folder, address = self.server.root / repo, f"{self.server.address}/{repo}"
        if folder.is_dir():
            raise RefusalError(409, "", "You already created this model repo", url=address)
        folder.mkdir(parents=True)
        private = wanted.get("visibility") == "private"
        self.server.write_state(repo, {"private": private, "commits": []})
        self.json({"url": address})

    def accept_card(self, body: bytes) -> None:
        """Checks only that there is metadata."""
        assert json.loads(body)["content"].startswith("---\n")
        self.json({"errors": [], "warnings": []})

    def upload_modes(self, body: bytes, repo: str) -> None:
        """States which files are large."""
        self.check(repo, writes=True)
        files = [
            {"path": file["path"], "shouldIgnore": False} for file in json.loads(body)["files"]
        ]
        for file in files:
            file["uploadMode"] = "lfs" if file["path"].endswith(LARGE) else "regular"
        self.json({"files": files})

    def large_batch(self, body: bytes, repo: str) -> None:
        """Names the addresses to which large files are uploaded."""
        self.check(repo, writes=True)
        objects = json.loads(body)["objects"]
        for wanted in objects:
            href = f"{self.server.address}/large/{wanted['oid']}"
            wanted["actions"] = {"upload": {"href": href}}
        self.json({"transfer": "basic", "objects": objects})

    def store(self, body: bytes, oid: str) -> None:
        """Stores a large file."""
        assert hashlib.sha256(body).hexdigest() == oid
        (self.server.root / "large").mkdir(exist_ok=True)
        (self.server.root / "large" / oid).write_bytes(body)
        self.reply(b"", {})

    def add_commit(self, body: bytes, repo: str) -> None:
        """Adds a commit."""
        self.check(repo, writes=True)
        made = self.server.commit(repo, [json.loads(line) for line in body.splitlines()])
        self.json({"commitUrl": f"{self.server.address}/{repo}/commit/{made}", "commitOid": made})

    def info(self, body: bytes, repo: str, revision: str | None = None) -> None:
        """Describes a repository and its files."""
        self.check(repo, writes=False)
        made, folder = self.server.files(repo, revision)
        paths = sorted(folder.iterdir()) if folder else []
        self.json(
            {
                "id": repo,
                "sha": made,
                "private": self.server.state(repo)["private"],
                "siblings": [{"rfilename": it.name, "size": it.stat().st_size} for it in paths],
            }
        )

    def file(self, body: bytes, repo: str, revision: str, name: str) -> None:
        """Sends a file."""
        self.check(repo, writes=False)
        if self.server.state(repo).get("gated"):
            raise RefusalError(403, "GatedRepo", "Access to this repository is restricted")
        made, folder = self.server.files(repo, revision)
        if folder is None or not (folder / name).is_file():
            raise RefusalError(404, "EntryNotFound", "Entry not found")
        data = (folder / name).read_bytes()
        self.reply(data, {"ETag": f'"{hashlib.sha1(data).hexdigest()}"', "X-Repo-Commit": made})

    def log_message(self, format: str, *arguments: Any) -> None:
        """Suppresses the log line that the base class prints for each request."""


REPO = r"(?P<repo>[\w.-]+/[\w.-]+)"
ROUTES = [
    (("POST",), "/api/repos/create", Handler.create),
    (("POST",), "/api/validate-yaml", Handler.accept_card),
    (("POST",), rf"/api/models/{REPO}/preupload/main", Handler.upload_modes),
    (("POST",), rf"/{REPO}\.git/info/lfs/objects/batch", Handler.large_batch),
    (("PUT",), r"/large/(?P<oid>\w+)", Handler.store),
    (("POST",), rf"/api/models/{REPO}/commit/main", Handler.add_commit),
    (("GET",), rf"/api/models/{REPO}", Handler.info),
    (("GET",), rf"/api/models/{REPO}/revision/(?P<revision>[^/]+)", Handler.info),
    (("GET", "HEAD"), rf"/{REPO}/resolve/(?P<revision>[^/]+)/(?P<name>[^/]+)", Handler.file),
]


def environment(hub: StandIn, home: Path, token: str | None = WRITER) -> dict[str, str]:
    """Returns the environment of a client, which has no login and no cache of its own."""
    ours = {
        # The hub's newer storage has a protocol of its own.
        "HF_HUB_DISABLE_XET": "1",
        "HF_ENDPOINT": hub.address,
        "HF_HOME": str(home),
        "HF_HUB_DISABLE_TELEMETRY": "1",
    }
    others = {name: value for name, value in os.environ.items() if not name.startswith("HF_")}
    return others | ours | ({"HF_TOKEN": token} if token is not None else {})


@contextlib.contextmanager
def running(root: Path) -> Iterator[StandIn]:
    """Runs the stand-in until the end of the block."""
    root.mkdir(parents=True, exist_ok=True)
    with StandIn(root) as hub:
        threading.Thread(target=hub.serve_forever, daemon=True).start()
        yield hub
        hub.shutdown()


def main() -> int:
    """Runs a command beside a stand-in; returns its exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--token", default=WRITER, help="empty: none")
    parser.add_argument("--around", nargs=argparse.REMAINDER, required=True)
    arguments = parser.parse_args()
    with running(arguments.root.resolve()) as hub:
        ours = environment(hub, arguments.root.resolve() / "home", arguments.token or None)
        return subprocess.run(arguments.around, env=ours, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
