"""Environments of dmprl.

The rollout worker (Rust, ``actors/src/python_env``) embeds Python and calls
:func:`dmprl.segment_env.make`, then ``step_segment`` once per policy decision. Nothing is imported
here, so that ``import dmprl`` costs nothing.
"""

__version__ = "0.1.0"
