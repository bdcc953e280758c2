"""Shares policies on the Hugging Face hub, for ``dmprl push`` and ``dmprl pull``.

A repository has the policy's file, the files of the run that ``play`` and ``eval`` need, and a
model card (docs/sharing.md). :mod:`dmprl.hub.card` writes the card and needs no other package;
:mod:`dmprl.hub.transfer` needs ``huggingface_hub``, the extra ``hub``.
"""

POLICY = "policy.safetensors"
"""The policy, as ``dmprl export`` writes it."""
FILES = (POLICY, "config.toml", "spec.json", "evaluations.jsonl", "manifest.json")
"""Files of a repository that ``pull`` reads."""
FILM = "replay"
"""Name of the film, without its extension. The hub shows ``replay.mp4`` beside the card."""
FILM_EXTENSIONS = (".mp4", ".gif")


class HubError(Exception):
    """Raised if a policy cannot be uploaded or downloaded. The message is for the user."""


class RefusedError(HubError):
    """Raised if the request itself must change: its repository, token, revision or file."""
