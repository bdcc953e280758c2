"""Demonstrations of other formats, for ``dmprl demos`` and ``dmprl train --demos``.

Minari data sets and LeRobotDatasets become the file that the learner reads
(docs/demonstrations.md). The learner itself needs neither Python nor these packages.
"""
