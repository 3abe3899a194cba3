"""Where the camera looks: `fixed`, `moving` and `auto` are three estimators of one kind.

Frames are aligned with keyframes (`view_alignment`), keyframes hang together in a graph
(`keyframes`, `loops`), and a camera that has lost its place asks `relocalising`.
"""
