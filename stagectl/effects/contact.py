"""The joint in contact, beside the force K p of its stiffness, and where the edges of its gap are.

Forces push the joint's two parts apart; the plant keeps the sum from pulling. Edges move outward by metres, each side
by its own.
"""

import numpy as np

from stagectl.effects.declaration import Trait, effect
from stagectl.effects.elementary import fading


@effect(
    places=("contact",),
    damping_n_s_per_m=(0.0, 1e5),
    searched=("damping_n_s_per_m",),  # not linear: it decides where a contact lets go
    shown_by="contact",
    symptom="proportional to the speed of the joint, in contact only",
    reference="Kelvin-Voigt contact; Kang et al. 2023, section 6.1",
)
def contact_damping(penetration_velocity_m_per_s, damping_n_s_per_m):
    """Damping of the joint in contact: F = c dp/dt (the contact never pulls: the plant sees to that)."""
    return damping_n_s_per_m * penetration_velocity_m_per_s


@effect(
    places=("contact",),
    left_error_ratio=(-0.9, 2.0),
    right_error_ratio=(-0.9, 2.0),
    linear=("left_error_ratio", "right_error_ratio"),
    traits=(Trait.KNOWN_PARAMETER,),
    symptom="proportional to the penetration, with another share on each side",
    reference="Kang et al. 2023, (5), K_l and K_r",
)
def contact_stiffness_error(
    penetration_m, contact_stiffness_n_per_m, contact_side_ratio, left_error_ratio, right_error_ratio
):
    """Stiffness of the contact that differs from its nominal value: F = e_l K_l p left, e_r K_r p right."""
    right = 0.5 * (1.0 + contact_side_ratio)
    error = left_error_ratio + (right_error_ratio - left_error_ratio) * right
    return error * contact_stiffness_n_per_m * penetration_m


@effect(
    places=("contact",),
    knee_m=(1e-8, 1e-3),
    searched=("knee_m",),
    shown_by="contact",
    symptom="contact force that sets in gently: less than linear by the same amount from a few micrometres on",
    reference="Kang et al. 2023, section 6.1: a rounded knee; Johnson, Contact Mechanics, section 4.3",
)
def soft_contact(penetration_m, contact_stiffness_n_per_m, knee_m):
    """Contact with a rounded knee: in all F = K p^2 / (2 delta) below delta, K (p - delta / 2) beyond."""
    below = np.minimum(penetration_m, knee_m)
    return contact_stiffness_n_per_m * (0.5 * below * below / knee_m - below)


@effect(
    places=("contact",),
    memory=1,
    loss_ratio=(0.0, 0.9),
    turn_m=(1e-8, 1e-3),
    linear=("loss_ratio",),
    searched=("turn_m",),
    shown_by="contact",
    symptom="contact force larger when pressing than when letting go, whatever the speed",
    reference="Kang et al. 2023, section 6.1: a loop in the measured contact; Dahl, Aerospace Corp. TOR-0158, 1968",
)
def contact_hysteresis(
    penetration_m, penetration_velocity_m_per_s, contact_stiffness_n_per_m, dt_s, loss_ratio, turn_m, memory
):
    """Loss of the contact's material, the same at any speed: F = h K p z, dz/dt = (dp/dt - |dp/dt| z) / delta.

    z is 1 while it is pressed and -1 while it lets go, and turns over a way, `turn_m`, and not over a speed: asperities
    give way before they slip. What touches anew is pressed. memory: 1 - z. Its step is exact for constant dp/dt.
    """
    if penetration_m <= 0.0:
        if dt_s > 0.0:
            memory[0] = 0.0
        return 0.0
    before = memory[0]
    goal = 0.0 if penetration_velocity_m_per_s >= 0.0 else 2.0
    memory[0] = goal + (before - goal) * fading(abs(penetration_velocity_m_per_s) * dt_s / turn_m)
    return loss_ratio * contact_stiffness_n_per_m * penetration_m * (1.0 - 0.5 * (before + memory[0]))


@effect(
    places=("contact_edge",),
    change_m=(-1e-2, 1e-2),
    linear=("change_m",),
    traits=(Trait.KNOWN_PARAMETER,),
    symptom="contact sets in later (or earlier), by the same on both sides",
    reference="Kang et al. 2023, (5): b = b_l + b_r",
)
def backlash_width_change(contact_side_ratio, change_m):
    """Gap that is wider: each edge lies db / 2 further out."""
    return 0.5 * change_m + 0.0 * contact_side_ratio


@effect(
    places=("contact_edge",),
    shift_m=(-1e-2, 1e-2),
    linear=("shift_m",),
    session=("shift_m",),
    shown_by="contact",
    symptom="contact sets in later on one side, and earlier by the same on the other",
    reference="Kang et al. 2023, (5): (b_r - b_l) / 2; belongs to one homing",
)
def backlash_centre_shift(contact_side_ratio, shift_m):
    """Gap that lies elsewhere: the right edge (macro ahead) lies c further out, the left edge c further in."""
    return contact_side_ratio * shift_m


@effect(
    places=("contact_edge",),
    rate_m_per_s=(0.0, 1e-4),
    linear=("rate_m_per_s",),
    shown_by="contact",
    symptom="contact sets in later and later in the course of a run",
    reference="Archard, J. Appl. Phys. 24, 1953, at constant load and motion: depth grows with time",
)
def backlash_wear(t_s, rate_m_per_s):
    """Gap that grows: each edge lies w t / 2 further out, t since the machine was switched on."""
    return 0.5 * rate_m_per_s * t_s
