"""Kang et al., Machines 11(12):1044, 2023, run as printed and as corrected. One file a part of the paper.

Nothing here drives a stage: what the project takes over stands corrected in `stagectl.plant`, `stagectl.laws` and
`stagectl.backlash`. Where the paper contradicts itself the docstring of the function says which reading is taken.
"""
