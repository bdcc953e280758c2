"""Uploads or downloads a policy; started by ``dmprl push`` and ``dmprl pull``.

``python -m dmprl.hub push FOLDER OWNER/NAME`` and ``python -m dmprl.hub pull FOLDER OWNER/NAME``.
The result goes into the file ``--answer``, as one JSON object: ``address`` and ``commit``, or
``error``. The exit status is 2 if the request must change, and 1 after other errors. Progress goes
to standard error.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from dmprl.hub import FILES, FILM, HubError, RefusedError, card
from dmprl.hub.transfer import Hub

FAILED, REFUSED, INTERRUPTED = 1, 2, 130
"""Exit statuses."""
README = "README.md"


def arguments_of(words: list[str]) -> argparse.Namespace:
    """Parses the command line."""
    parser = argparse.ArgumentParser(prog="dmprl hub")
    parser.add_argument("action", choices=["push", "pull"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("repo")
    parser.add_argument("--answer", type=Path, required=True)
    parser.add_argument("--policy-version", type=int)
    parser.add_argument("--private", action="store_true")
    parser.add_argument("--film", type=Path)
    parser.add_argument("--message")
    parser.add_argument("--revision")
    return parser.parse_args(words)


def push(arguments: argparse.Namespace, hub: Hub) -> str:
    """Writes the card and uploads everything; returns the id of the commit."""
    folder, film = arguments.folder, arguments.film
    hub.create(arguments.private)
    files = {name: folder / name for name in (README, *FILES)}
    address = None
    if film is not None:
        name = FILM + film.suffix.lower()
        files[name] = film
        address = f"{hub.address}/resolve/main/{name}"
    facts = card.read(folder, arguments.repo, arguments.policy_version, address)
    files[README].write_text(card.model_card(facts), encoding="utf-8")
    kib = sum(path.stat().st_size for path in files.values()) / 1024
    print(f"uploading {len(files)} files ({kib:,.0f} KiB) to {hub.address}", file=sys.stderr)
    return hub.upload(files, arguments.message)


def pull(arguments: argparse.Namespace, hub: Hub) -> str:
    """Downloads the files of a policy; returns the id of their commit."""
    print(f"downloading {hub.address}", file=sys.stderr)
    return hub.download(arguments.folder, arguments.revision)


def main(words: list[str]) -> int:
    """Runs one command; returns the exit status."""
    arguments = arguments_of(words)
    hub = Hub(arguments.repo)
    status = 0
    try:
        commit = (push if arguments.action == "push" else pull)(arguments, hub)
        answer = {"address": hub.address, "commit": commit}
    except HubError as error:
        answer = {"error": str(error)}
        status = REFUSED if isinstance(error, RefusedError) else FAILED
    except KeyboardInterrupt:
        return INTERRUPTED
    arguments.answer.write_text(json.dumps(answer))
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
