"""Shows and converts demonstrations; started by ``dmprl demos`` and ``dmprl train --demos``.

``python -m dmprl.demos show SOURCE`` and ``python -m dmprl.demos convert SOURCE OUTPUT``. The
result goes to standard output. If the source cannot be used, the reason goes to standard error, and
the exit status is 2.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from dmprl import SHORT_NAMES, python_path
from dmprl.demos import converting, summary
from dmprl.demos.converting import Conversion, Wishes, convert
from dmprl.demos.opening import open_source
from dmprl.demos.source import DemosError
from dmprl.demos.task import Task
from dmprl.env_options import NO_OPTIONS, EnvOptions

REFUSED = 2
"""Exit status if the source cannot be used."""


def arguments_of(words: list[str]) -> argparse.Namespace:
    """Parses the command line."""
    parser = argparse.ArgumentParser(prog="dmprl demos")
    parser.add_argument("action", choices=["show", "convert"])
    parser.add_argument("source")
    parser.add_argument("output", nargs="?", type=Path)
    parser.add_argument("--task")
    parser.add_argument("--options", type=EnvOptions.parse, default=NO_OPTIONS, help="TOML")
    parser.add_argument("--action-range", type=float, default=1.0)
    parser.add_argument("--python-path", action="append", default=[])
    parser.add_argument("--observation", type=lambda text: tuple(text.split(",")), default=())
    parser.add_argument("--action-column")
    parser.add_argument("--reward")
    parser.add_argument("--rate", type=float)
    parser.add_argument("--recorded-rate", type=float)
    parser.add_argument("--episodes", type=int)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args(words)
    if (arguments.output is not None) != (arguments.action == "convert"):
        parser.error("convert needs an output, show has none")
    return arguments


def main(words: list[str]) -> int:
    """Runs one command; returns the exit status."""
    arguments = arguments_of(words)
    wishes = Wishes(
        arguments.observation,
        arguments.action_column,
        arguments.reward,
        arguments.rate,
        arguments.recorded_rate,
        arguments.episodes,
    )
    try:
        python_path.extend(arguments.python_path)
        source = open_source(arguments.source)
        task = None
        if arguments.task is not None:
            task_id = SHORT_NAMES.get(arguments.task, arguments.task)
            task = Task(task_id, arguments.options, arguments.action_range)
        if arguments.action == "show":
            result = summary.summarise(source, task, wishes)
            text = summary.text_of(result)
        else:
            result = convert(Conversion(source, task, wishes), arguments.output)
            text = converting.text_of(result)
    except DemosError as error:
        print(error, file=sys.stderr)
        return REFUSED
    print(json.dumps(result) if arguments.json else text)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
