"""The gap workflow: where simulation and measurement disagree, which effect is missing, and what remains."""
