"""Section 3.1: the quasi-linear model (6)-(9) against the piecewise one (5)."""

import numpy as np

from stagectl.paper import quasi_linear
from stagectl.paper.figures import CORRECTED, PRINTED, REFERENCE, Curve, Panel, drawn
from stagectl.paper.printed_values import RIG_6_1, TABLE_2
from stagectl.paper.rows import Chapter, Row
from stagectl.report import Figure

_DRAWS_COUNT = 1_000_000


def chapter() -> Chapter:
    """Work section 3.1 through."""
    joint = RIG_6_1
    numbers = (joint.left_m, joint.right_m, joint.left_stiffness_n_per_m, joint.right_stiffness_n_per_m)
    x_b = np.random.default_rng(1).uniform(-5.0 * joint.width_m, 5.0 * joint.width_m, _DRAWS_COUNT)
    forces = quasi_linear.forces(x_b, *numbers)
    # (8) is a difference of products: rounding is that of its largest one
    largest = max(numbers[2:]) * (np.abs(x_b) + joint.width_m)
    share = float(np.max(np.abs(forces[:, 1] - forces[:, 0]) / largest))
    table_2 = (TABLE_2.left_m, TABLE_2.right_m, TABLE_2.left_stiffness_n_per_m, TABLE_2.right_stiffness_n_per_m)
    middle = quasi_linear.forces(np.zeros(1), *table_2)[0]
    grid = np.linspace(-0.15, 0.15, 1201)
    curve = quasi_linear.forces(grid, *table_2)
    panel = Panel(
        "F_b (N)",
        [
            Curve("(8) with the condition x_b - b_l of (7)", 1e3 * grid, curve[:, 2], PRINTED),
            Curve("(5), piecewise", 1e3 * grid, curve[:, 0], REFERENCE, "-", 2.0),
            Curve("(8) with x_b + b_l", 1e3 * grid, curve[:, 1], CORRECTED, "--"),
        ],
    )
    return Chapter(
        "quasi-linear",
        "3.1",
        "Quasi-linear backlash model, (6)-(9)",
        [
            Row(
                "(5), (9)",
                "largest difference of both models, share of the largest product in (8), a million draws",
                "1",
                0.0,
                None,
                share,
                "rounding (2.2e-16 is one unit in the last place); a property test holds it for any joint",
            ),
            Row(
                "(7), (8)",
                "force in the middle of Table 2's gap",
                "N",
                0.0,
                float(middle[2]),
                float(middle[1]),
                "condition of the left side: x_b - b_l makes the gap's left part a contact; only x_b + b_l "
                "agrees with (5)",
            ),
        ],
        [
            Figure(
                "Force over relative position (the paper's Fig. 5)",
                drawn([panel], "x_b (mm)"),
                "Table 2's joint.",
                "Force over relative position: both models agree with the corrected condition.",
            )
        ],
        ["The minus of theta_b's last term stands in h_b; (9) prints it once."],
    )
