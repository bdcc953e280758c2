"""Counts phrases that make technical English hard to read, and lists where they are.

`tests/tests/tidy/language.rs` runs this script and limits the count. Without options the script
prints the count of each pattern, with `--list` every match as FILE:LINE. `--root DIR` reads another
checkout, which must be a Git repository.
"""

import argparse
import json
import re
import subprocess
from pathlib import Path

SUFFIXES = {
    ".css",
    ".html",
    ".js",
    ".md",
    ".py",
    ".rs",
    ".service",
    ".sh",
    ".toml",
    ".yaml",
    ".yml",
}
# Generated from the sources, results of runs, or this list.
EXCLUDED = ("docs/configuration-keys.md", "docs/results/", "tests/prose.py")

VERBS = (
    "is|was|are|were|has|have|had|can|cannot|could|does|do|did|would|will|must|may|belongs|comes|"
    "lies|stands|makes|remains|holds|waits|runs|takes|falls|differs|became|becomes|needs|lacks|"
    "goes|gives"
)
PRONOUNS_AND_ARTICLES = "it|they|he|she|one|a|an|the|no|that|this|there|those|these|we|its|each|all"
PATTERNS = {
    "indefinite person": r"\b(?:nobody|somebody|anybody|everybody|whoever|whomever|no one)\b",
    "what clause": rf"\bwhat (?:{VERBS}|{PRONOUNS_AND_ARTICLES})\b(?![^.]*\?)",
    "who as a subject": r"(?:^|[.;:] )who \w+s\b",
    "personification": (
        r"\b(?:is|are|was|were|be|been) told\b|\btells? (?:it|them|of)\b"
        r"|\bcomes? to be\b|\bcame to be\b"
        r"|\b(?:has|have|had|is|are) lived\b|\bthat lives?\b|\bsays? nothing\b|\bknows? nothing\b"
    ),
    "stands, lies, goes on": (
        r"\bstands? (?:on|in|for|at|still|there|here|beside|before|once|as)\b"
        r"|\blies? (?:in|on|at|there|here|beside|below|above)\b|\b(?:goes|go|went|going) on\b"
    ),
    "is to be": (
        r"\b(?:is|are|was|were) (?:not )?to be (?:had|\w+ed|done|made|found|seen|kept|known)\b"
    ),
    "is such": r"\b(?:is|are|was|were|that are) (?:no )?such\b(?! as)|\bas such\b",
    "literal translation": r"\bin the moment\b|\bto the one\b|\bthe same again\b|\bin want of\b",
}
COMPILED = {name: re.compile(pattern, re.IGNORECASE) for name, pattern in PATTERNS.items()}
MID_SENTENCE = "doc comment without an end"
DOC_LINE = re.compile(r"\s*//[/!] ?(.*)$")
COMPLETE = re.compile(r"[.:!?)|`\]>*]$|^\s*[-*\d|#`\[]|^    ")


def main():
    """Prints the counts or the matches."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, default=Path(__file__).resolve().parent.parent)
    parser.add_argument("--list", action="store_true", help="print every match")
    parser.add_argument("--json", action="store_true", help="print the counts as JSON")
    arguments = parser.parse_args()
    matches = find_matches(arguments.root)
    counts = {name: len(matches[name]) for name in matches}
    if arguments.list:
        for name, places in matches.items():
            for file, line, text in places:
                print(f"{file}:{line}: {name}: {text}")
    elif arguments.json:
        print(json.dumps({"total": sum(counts.values()), "patterns": counts}))
    else:
        for name, count in counts.items():
            print(f"{count:6}  {name}")
        print(f"{sum(counts.values()):6}  total")


def find_matches(root):
    """Returns the matches of each pattern as (file, line, text), in the files that Git knows."""
    matches = {name: [] for name in [*COMPILED, MID_SENTENCE]}
    for file in text_files(root):
        lines = (root / file).read_text(encoding="utf-8").splitlines()
        for number, line in enumerate(lines, start=1):
            for name, pattern in COMPILED.items():
                matches[name] += [
                    (file, number, found.group(0)) for found in pattern.finditer(line)
                ]
        if file.endswith(".rs"):
            matches[MID_SENTENCE] += [(file, *end) for end in unfinished_docs(lines)]
    return matches


def text_files(root):
    """Returns the paths, relative to the root, of the files that people read."""
    listing = subprocess.run(
        ["git", "-C", str(root), "ls-files", "--cached", "--others", "--exclude-standard"],
        check=True,
        capture_output=True,
        text=True,
    )
    return [
        path
        for path in listing.stdout.splitlines()
        if Path(path).suffix in SUFFIXES
        and not path.startswith(EXCLUDED)
        and (root / path).is_file()
    ]


def unfinished_docs(lines):
    """Yields (line number, text) of each doc comment whose last line does not end a sentence."""
    fenced = False
    for number, (line, following) in enumerate(zip(lines, [*lines[1:], ""], strict=True), start=1):
        doc = DOC_LINE.match(line)
        if not doc:
            fenced = False
            continue
        text = doc.group(1).rstrip()
        fenced ^= text.startswith("```")
        if not fenced and text and not DOC_LINE.match(following) and not COMPLETE.search(text):
            yield number, text[-40:]


if __name__ == "__main__":
    main()
