"""Uploads and downloads the files of a policy with ``huggingface_hub``."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from huggingface_hub import (
    CommitOperationAdd,
    CommitOperationDelete,
    HfApi,
    get_token,
    hf_hub_download,
)
from huggingface_hub.errors import (
    GatedRepoError,
    HfHubHTTPError,
    HFValidationError,
    HTTPError,
    LocalEntryNotFoundError,
    OfflineModeIsEnabled,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)
from huggingface_hub.utils import disable_progress_bars

import dmprl
from dmprl.hub import FILES, FILM, FILM_EXTENSIONS, POLICY, HubError, RefusedError

FILE_BYTES_MAX = 1 << 30
"""Maximum size of a file that is downloaded. A larger one is not of a policy."""
LISTED_MAX = 8
"""Maximum number of files that an error lists."""
LOGIN = f"{Path(sys.executable).with_name('hf')} auth login"
"""Command that stores a token."""
UNAUTHORIZED, FORBIDDEN = 401, 403


class Hub:
    """One repository on the hub that ``HF_ENDPOINT`` names, huggingface.co by default."""

    def __init__(self, repo: str) -> None:
        self._api = HfApi(library_name="dmprl", library_version=dmprl.__version__)
        self._repo = repo
        if not sys.stderr.isatty():
            disable_progress_bars()

    @property
    def endpoint(self) -> str:
        """Address of the hub."""
        return self._api.endpoint

    @property
    def address(self) -> str:
        """Address of the repository."""
        return f"{self.endpoint}/{self._repo}"

    def create(self, private: bool) -> None:
        """Creates the repository if it does not exist.

        :raises RefusedError: if there is no token, it may not write, or the repository is public
            although it must be private.
        """
        if get_token() is None:
            raise RefusedError(
                f"no token for {self.endpoint}: expected one with write access in HF_TOKEN, or a "
                f"login; create one at {self.endpoint}/settings/tokens, then: {LOGIN}"
            )
        with self._errors():
            # Only a new repository gets the visibility.
            self._api.create_repo(self._repo, private=private or None, exist_ok=True)
            if private and not self._api.model_info(self._repo).private:
                raise RefusedError(
                    f"{self.address} exists and is public; --private is for a new repository. "
                    f"Change it in {self.address}/settings, or choose another name"
                )

    def upload(self, files: dict[str, Path], message: str) -> str:
        """Uploads files by their names in the repository, in one commit; returns its id.

        A film of an earlier upload is removed, because it shows another policy.
        """
        with self._errors():
            there = {file.rfilename for file in self._info(None).siblings}
            films = {FILM + extension for extension in FILM_EXTENSIONS}
            operations: list[Any] = [
                CommitOperationDelete(name) for name in films & there - {*files}
            ]
            operations += [CommitOperationAdd(name, path) for name, path in files.items()]
            return self._api.create_commit(self._repo, operations, commit_message=message).oid

    def download(self, folder: Path, revision: str | None) -> str:
        """Downloads the files of a policy into a folder; returns the id of their commit.

        :raises RefusedError: if the repository, the revision or a file does not exist.
        """
        with self._errors(revision):
            info = self._info(revision)
            sizes = {file.rfilename: file.size or 0 for file in info.siblings}
            if missing := [name for name in FILES if name not in sizes]:
                raise RefusedError(self._is_no_policy(missing, sorted(sizes)))
            for name in FILES:
                if sizes[name] > FILE_BYTES_MAX:
                    raise HubError(
                        f"{self.address}: {name} has {sizes[name]} bytes, expected at most "
                        f"{FILE_BYTES_MAX}"
                    )
            for name in FILES:
                hf_hub_download(self._repo, name, revision=info.sha, local_dir=folder)
            return info.sha

    def _info(self, revision: str | None) -> Any:
        return self._api.model_info(self._repo, revision=revision, files_metadata=True)

    def _is_no_policy(self, missing: list[str], there: list[str]) -> str:
        others = len(there) - LISTED_MAX
        listed = ", ".join(there[:LISTED_MAX]) + (f" and {others} others" if others > 0 else "")
        if POLICY in missing:
            reason = f"is not a policy of dmprl: it has no {POLICY}"
        else:
            reason = f"cannot be played: it lacks {', '.join(missing)}"
        return (
            f"{self.address} {reason}; its files: {listed or 'none'}. Expected a repository that "
            "dmprl push made"
        )

    @contextlib.contextmanager
    def _errors(self, revision: str | None = None) -> Iterator[None]:
        """Raises errors of the library and the network as errors for the user."""
        try:
            yield
        except HFValidationError as error:
            raise RefusedError(f"{self._repo}: expected OWNER/NAME: {error}") from error
        except RevisionNotFoundError as error:
            raise RefusedError(
                f"{self.address} has no revision {revision}: expected a branch, a tag or the id of "
                f"a commit; see {self.address}/commits/main"
            ) from error
        except GatedRepoError as error:
            raise RefusedError(
                f"{self.address} is open on request only: ask for access on that page, then set "
                f"HF_TOKEN, or run {LOGIN}"
            ) from error
        except RepositoryNotFoundError as error:
            seen = "it is private and HF_TOKEN or the login may not read it"
            if get_token() is None:
                seen = f"it is private: set HF_TOKEN, or run {LOGIN}"
            raise RefusedError(f"there is no repository {self.address}, or {seen}") from error
        except HfHubHTTPError as error:
            raise self._answered(error) from error
        except (HTTPError, LocalEntryNotFoundError, OfflineModeIsEnabled) as error:
            raise HubError(
                f"cannot reach {self.endpoint}: {first_line(error)}. Check the network, "
                "HTTPS_PROXY, HF_ENDPOINT and HF_HUB_OFFLINE, and repeat the command"
            ) from error

    def _answered(self, error: HfHubHTTPError) -> HubError:
        """Returns the error for an answer of the hub that is not a success."""
        status = error.response.status_code
        if status == UNAUTHORIZED:
            return RefusedError(
                f"{self.endpoint} does not accept the token: expected a valid one in HF_TOKEN or "
                f"from a login; create one at {self.endpoint}/settings/tokens, then: {LOGIN}"
            )
        if status == FORBIDDEN:
            return RefusedError(
                f"the token may not do this with {self.address}: expected one with write access "
                f"(to pull, read access) for {self._repo.partition('/')[0]}; create one at "
                f"{self.endpoint}/settings/tokens"
            )
        said = error.server_message or first_line(error)
        return HubError(f"{self.address}: the hub answered with status {status}: {said}")


def first_line(error: BaseException) -> str:
    """Returns the first line of an error's message, or its class if it has none."""
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
