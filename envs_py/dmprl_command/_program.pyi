"""The program as an extension module, which only a wheel has (deploy/extension)."""

from typing import NoReturn

def run(words: list[str]) -> NoReturn: ...
