"""The true machine and its closed loop: a macro axis, an end stage on it, stops between them; or the macro axis alone.

Position half steps around a velocity step at the midpoint (second order); dry friction as an impulse that can stop an
axis and never turn it; currents exactly through their first-order loops. 50 us a step, commands held for 1 ms.
"""

import math

import numpy as np

from tests.blind import laws
from tests.blind.compiled import compiled
from tests.blind.laws import contact_force, dead_zone, friction_level, is_contact, is_friction, smooth_force, thrust

SAMPLE_S = 1e-3
STEPS = 20  # a sample
STEP_S = SAMPLE_S / STEPS
CELL_STEPS = 5  # steps a cell of the fine record: 0.25 ms
CELLS = STEPS // CELL_STEPS

BASE = (
    "macro_mass_kg",
    "micro_mass_kg",
    "macro_force_constant_n_per_a",
    "micro_force_constant_n_per_a",
    "spring_stiffness_n_per_m",
    "spring_damping_n_s_per_m",
    "left_contact_stiffness_n_per_m",
    "right_contact_stiffness_n_per_m",
    "left_edge_m",
    "right_edge_m",
    "contact_damping_n_s_per_m",
    "macro_damping_n_s_per_m",
    "macro_command_delay_s",
    "micro_command_delay_s",
    "macro_current_lag_s",
    "micro_current_lag_s",
    "micro_reaction",
)
B = {name: i for i, name in enumerate(BASE)}
(M1, M2, K1, K2, SPRING, DAMPING, KL, KR, LEFT, RIGHT, CONTACT_C, GROUND_C, D1, D2, L1, L2, REACTION) = range(len(BASE))
CONTROL = (
    "macro_position_gain_per_s",
    "macro_velocity_gain_n_s_per_m",
    "macro_integral_gain_per_s",
    "macro_velocity_filter_hz",
    "macro_acceleration_feedforward_kg",
    "macro_velocity_feedforward_n_s_per_m",
    "macro_force_limit_n",
    "micro_position_gain_per_s",
    "micro_velocity_gain_n_s_per_m",
    "micro_integral_gain_per_s",
    "micro_velocity_filter_hz",
    "micro_acceleration_feedforward_kg",
    "spring_feedforward_n_per_m",
    "micro_force_limit_n",
    "reaction_decoupling",
    "macro_force_constant_n_per_a",
    "micro_force_constant_n_per_a",
)
C = {name: i for i, name in enumerate(CONTROL)}
CONTROL_STATE = 6  # macro: last reading, filtered speed, integral; micro: the same


@compiled
def axis_law(gains, state, at, reference, speed, reading, first):
    """Cascaded position and velocity loop: force in N before feed-forward. `at` is its first state."""
    kp, kv, ki, filter_hz = gains[0], gains[1], gains[2], gains[3]
    if first:
        state[at], state[at + 1], state[at + 2] = reading, 0.0, 0.0
    smooth = -math.expm1(-2.0 * math.pi * filter_hz * SAMPLE_S)
    state[at + 1] += smooth * ((reading - state[at]) / SAMPLE_S - state[at + 1])
    state[at] = reading
    miss = speed + kp * (reference - reading) - state[at + 1]
    state[at + 2] += ki * SAMPLE_S * miss
    return kv * (miss + state[at + 2])


@compiled
def control(c, state, reference, relative, y1, y2, first, single):
    """Commands (macro, micro) in N. reference: position, speed, acceleration; relative: of end minus macro."""
    u2 = 0.0
    if not single:
        u2 = axis_law(c[7:11], state, 3, reference[0], reference[1], y2, first)
        u2 += c[11] * reference[2] + c[12] * relative[0]
        u2 = min(max(u2, -c[13]), c[13])
    speed = reference[1] - relative[1]
    u1 = axis_law(c[0:4], state, 0, reference[0] - relative[0], speed, y1, first)
    u1 += c[4] * (reference[2] - relative[2]) + c[5] * speed - c[12] * relative[0] + c[14] * u2
    u1 = min(max(u1, -c[6]), c[6])
    return u1, u2


@compiled
def loop_step(current, commands, k, s, delay, lag, dead):
    """A current loop over one step from s after sample k: (current at its end, its mean)."""
    i0 = k + math.floor((s - delay) / SAMPLE_S + 1e-9)
    i1 = k + math.floor((s + STEP_S - delay) / SAMPLE_S + 1e-9)
    old = dead_zone(dead, commands[i0]) if i0 >= 0 else 0.0
    if i0 == i1:
        e = math.exp(-STEP_S / lag)
        return old + (current - old) * e, old + (current - old) * (1.0 - e) * lag / STEP_S
    new = dead_zone(dead, commands[i1]) if i1 >= 0 else 0.0
    h = min(max(delay + (i1 - k) * SAMPLE_S - s, 0.0), STEP_S)
    e = math.exp(-h / lag)
    middle = old + (current - old) * e
    total = old * h + (current - old) * (1.0 - e) * lag
    e = math.exp(-(STEP_S - h) / lag)
    total += new * (STEP_S - h) + (middle - new) * (1.0 - e) * lag
    return new + (middle - new) * e, total / STEP_S


@compiled
def at_time(fine, start, filled, t):
    """Position at a time t >= 0 on a cubic through four points of the fine record; before the start it stands.

    On a line between two points it would be 2 nm off at 10 m/s2, and a late sensor would seem to make a drive late.
    """
    place = t / STEP_S
    i = math.floor(place)
    if i < 0:
        return start
    if i >= filled - 1:
        return fine[filled - 1]
    if filled < 4:
        return fine[i] + (place - i) * (fine[i + 1] - fine[i])
    first = min(max(i - 1, 0), filled - 4)
    z = place - first
    return (
        fine[first] * (z - 1.0) * (z - 2.0) * (z - 3.0) / -6.0
        + fine[first + 1] * z * (z - 2.0) * (z - 3.0) / 2.0
        + fine[first + 2] * z * (z - 1.0) * (z - 3.0) / -2.0
        + fine[first + 3] * z * (z - 1.0) * (z - 2.0) / 6.0
    )


@compiled
def simulate(base, payload, single, c, reference, relative, coloured, noise, t0, codes, places, p):
    """One run of the closed loop.

    base: BASE; c: CONTROL; reference, relative: (n, 3); coloured: (n + 1, 2) N on each axis at the samples;
    noise: (n, 2) m on each sensor; t0: session time at the start, for drift and wear; codes, places (0 macro, 1 end),
    p: the effects.
    Returns samples (n, 8): readings, commands in N, currents, true positions; cells (n * CELLS, 8): x1, v1, x2, v2,
    drive 1, drive 2, direction of dry friction on each axis; marks (effects, 2, n * CELLS): the force of each effect on
    each axis; and (effects, n): the sensor error or the current that each effect makes.
    """
    n = reference.shape[0]
    effects = len(codes)
    samples = np.zeros((n, 8))
    cells = np.zeros((n * CELLS, 8))
    marks = np.zeros((effects, 2, n * CELLS))
    errors = np.zeros((effects, n))
    fine1, fine2 = np.zeros(n * STEPS + 1), np.zeros(n * STEPS + 1)
    commands1, commands2 = np.zeros(n), np.zeros(n)
    mem, pair_mem = np.zeros((effects, laws.MEMORIES)), np.zeros((effects, laws.MEMORIES))
    lagged = np.zeros(effects)
    state = np.zeros(CONTROL_STATE)
    x1, x2 = reference[0, 0] - relative[0, 0], reference[0, 0]
    if single:
        x2 = 0.0
    v1, v2 = 0.0, 0.0
    fine1[0], fine2[0] = x1, x2
    m1, m2 = base[0], base[1] + payload
    if single:
        m1 += payload
    whole1, whole2 = m1, m2
    i1, i2, n1, n2 = 0.0, 0.0, 0.0, 0.0
    delay1, delay2, lag1, lag2, dead1, dead2 = base[12], base[13], base[14], base[15], 0.0, 0.0
    thrust1, thrust2, contact_code = -1, -1, -1
    loop_changed = False
    for e in range(effects):
        if codes[e] == 28:
            if places[e] == 0:
                m1 -= p[e, 0] * whole1
                mem[e, 0] = x1
            else:
                m2 -= p[e, 0] * whole2
                mem[e, 0] = x2
        if codes[e] == 30:
            loop_changed = True
            if places[e] == 0:
                lag1 += p[e, 0]
            else:
                lag2 += p[e, 0]
        if codes[e] == 31:
            loop_changed = True
            if places[e] == 0:
                delay1 += p[e, 0]
            else:
                delay2 += p[e, 0]
        if codes[e] == 32:
            loop_changed = True
            if places[e] == 0:
                dead1 = p[e, 0]
            else:
                dead2 = p[e, 0]
        if codes[e] == 13 or codes[e] == 14:
            if places[e] == 0:
                thrust1 = e
            else:
                thrust2 = e
        if is_contact(codes[e]):
            contact_code = e
        if codes[e] == 34:
            lagged[e] = x1 if places[e] == 0 else x2
    contact = np.array([base[6], base[7], base[8], base[9], base[10]])
    empty = np.zeros(laws.PARAMETERS)
    empty_mem = np.zeros(laws.MEMORIES)
    h = STEP_S
    for k in range(n):
        t = k * SAMPLE_S
        # ---- sensors ----
        y1, y2 = x1, x2
        for e in range(effects):
            code = codes[e]
            if not (33 <= code <= 39):
                continue
            x = x1 if places[e] == 0 else x2
            fine = fine1 if places[e] == 0 else fine2
            error = 0.0
            if code == 33:
                error = at_time(fine, fine[0], k * STEPS + 1, t - p[e, 0]) - x
            elif code == 39:
                error = at_time(fine, fine[0], k * STEPS + 1, t - p[e, 0] * (t0 + t)) - x
            elif code == 34:
                error = lagged[e] - x
            else:
                error = laws.reading_error(code, p[e], t0 + t, x)
            errors[e, k] = error
            if places[e] == 0:
                y1 += error
            else:
                y2 += error
        y1 += noise[k, 0]
        y2 += noise[k, 1]
        u1, u2 = control(c, state, reference[k], relative[k], y1, y2, k == 0, single)
        commands1[k], commands2[k] = u1 / c[15], u2 / c[16]
        samples[k, 0], samples[k, 1], samples[k, 2], samples[k, 3] = y1, y2, u1, u2
        samples[k, 4], samples[k, 5], samples[k, 6], samples[k, 7] = i1, i2, x1, x2
        if loop_changed:
            for e in range(effects):
                if 30 <= codes[e] <= 32:
                    errors[e, k] = i1 - n1 if places[e] == 0 else i2 - n2
        for j in range(STEPS):
            s = j * h
            now = t + s
            cell = k * CELLS + j // CELL_STEPS
            # ---- currents and drive forces ----
            i1, mean1 = loop_step(i1, commands1, k, s, delay1, lag1, dead1)
            mean2 = 0.0
            if not single:
                i2, mean2 = loop_step(i2, commands2, k, s, delay2, lag2, dead2)
            x1 += 0.5 * h * v1
            x2 += 0.5 * h * v2
            drive1, drive2 = base[2] * mean1, base[3] * mean2
            if thrust1 >= 0:
                drive1 = thrust(codes[thrust1], p[thrust1], base[2], mean1, x1)
                marks[thrust1, 0, cell] += (drive1 - base[2] * mean1) / CELL_STEPS
            if thrust2 >= 0:
                drive2 = thrust(codes[thrust2], p[thrust2], base[3], mean2, x2)
                marks[thrust2, 1, cell] += (drive2 - base[3] * mean2) / CELL_STEPS
                marks[thrust2, 0, cell] -= base[16] * (drive2 - base[3] * mean2) / CELL_STEPS
            if loop_changed:
                n1, plain1 = loop_step(n1, commands1, k, s, base[12], base[14], 0.0)
                plain2 = 0.0
                if not single:
                    n2, plain2 = loop_step(n2, commands2, k, s, base[13], base[15], 0.0)
                for e in range(effects):
                    if 30 <= codes[e] <= 32:
                        if places[e] == 0:
                            marks[e, 0, cell] += base[2] * (mean1 - plain1) / CELL_STEPS
                        else:
                            marks[e, 1, cell] += base[3] * (mean2 - plain2) / CELL_STEPS
                            marks[e, 0, cell] -= base[16] * base[3] * (mean2 - plain2) / CELL_STEPS
            part = (j + 0.5) / STEPS
            push1 = coloured[k, 0] + part * (coloured[k + 1, 0] - coloured[k, 0]) + drive1 - base[16] * drive2
            push2 = coloured[k, 1] + part * (coloured[k + 1, 1] - coloured[k, 1]) + drive2
            # ---- velocity at the midpoint ----
            w1, w2 = v1, v2
            f1, f2 = 0.0, 0.0
            for stage in range(2):
                dt = h if stage == 1 else 0.0
                r, speed = x2 - x1, w2 - w1
                f1, f2 = push1 - base[11] * w1, push2
                if not single:
                    between = base[4] * r + base[5] * speed
                    if contact_code >= 0:
                        e = contact_code
                        touch = contact_force(codes[e], p[e], pair_mem[e], dt, t0 + now, r, speed, contact)
                        if stage == 1:
                            plain = contact_force(-1, empty, empty_mem, 0.0, 0.0, r, speed, contact)
                            marks[e, 0, cell] += (touch - plain) / CELL_STEPS
                            marks[e, 1, cell] -= (touch - plain) / CELL_STEPS
                    else:
                        touch = contact_force(-1, empty, empty_mem, 0.0, 0.0, r, speed, contact)
                    f1 += between + touch
                    f2 -= between + touch
                for e in range(effects):
                    code = codes[e]
                    if is_friction(code) or is_contact(code) or (13 <= code <= 14) or (30 <= code <= 39):
                        continue
                    both = code == 18 or code == 29
                    dt = h if stage == 1 and code != 28 else 0.0
                    if places[e] == 0 or both:
                        f = smooth_force(code, p[e], mem[e], dt, now, x1, w1, drive2, whole1)
                        f1 += f
                        if stage == 1:
                            marks[e, 0, cell] += f / CELL_STEPS
                    if (places[e] == 1 or both) and not single:
                        f = smooth_force(code, p[e], mem[e], dt, now, x2, w2, drive1, whole2)
                        f2 += f
                        if stage == 1:
                            marks[e, 1, cell] += f / CELL_STEPS
                w1 = v1 + 0.5 * h * f1 / m1
                w2 = v2 + 0.5 * h * f2 / m2
            # `mem` was advanced with the midpoint's speed; now the whole step, then dry friction as an impulse
            old1, old2 = v1, v2
            v1 += h * f1 / m1
            v2 += h * f2 / m2
            direction1 = 1.0 if v1 > 0.0 else -1.0
            direction2 = 1.0 if v2 > 0.0 else -1.0
            level1, level2 = 0.0, 0.0
            for e in range(effects):
                if is_friction(codes[e]):
                    if places[e] == 0:
                        level1 += friction_level(codes[e], p[e], mem[e], h, x1, v1, drive1, direction1)
                    else:
                        level2 += friction_level(codes[e], p[e], mem[e], h, x2, v2, drive2, direction2)
            if level1 > 0.0:
                held = min(abs(v1) * m1 / h, level1)
                share1 = held / level1
                v1 -= direction1 * held * h / m1
                direction1 *= share1
            if level2 > 0.0:
                held = min(abs(v2) * m2 / h, level2)
                share2 = held / level2
                v2 -= direction2 * held * h / m2
                direction2 *= share2
            for e in range(effects):
                if is_friction(codes[e]):
                    if places[e] == 0:
                        f = friction_level(codes[e], p[e], mem[e], 0.0, x1, v1, drive1, math.copysign(1.0, direction1))
                        marks[e, 0, cell] -= direction1 * f / CELL_STEPS
                    else:
                        f = friction_level(codes[e], p[e], mem[e], 0.0, x2, v2, drive2, math.copysign(1.0, direction2))
                        marks[e, 1, cell] -= direction2 * f / CELL_STEPS
                elif codes[e] == 28:  # the attached body's own inertia is missing from a rigid axis
                    # and it moves on with the speed that the axis now has
                    if places[e] == 0:
                        marks[e, 0, cell] += p[e, 0] * whole1 * (v1 - old1) / h / CELL_STEPS
                        smooth_force(28, p[e], mem[e], h, now, x1, v1, 0.0, whole1)
                    else:
                        marks[e, 1, cell] += p[e, 0] * whole2 * (v2 - old2) / h / CELL_STEPS
                        smooth_force(28, p[e], mem[e], h, now, x2, v2, 0.0, whole2)
            x1 += 0.5 * h * v1
            x2 += 0.5 * h * v2
            if single:
                x2, v2 = 0.0, 0.0
            place = k * STEPS + j + 1
            fine1[place], fine2[place] = x1, x2
            for e in range(effects):
                if codes[e] == 34:
                    fine = fine1 if places[e] == 0 else fine2
                    slope = (fine[place] - fine[place - 1]) / h
                    target = fine[place] - slope * p[e, 0]  # a lag follows a ramp at this distance
                    before = fine[place - 1] - slope * p[e, 0]
                    lagged[e] = target + (lagged[e] - before) * math.exp(-h / p[e, 0])
            cells[cell, 0] += 0.5 * (fine1[place - 1] + x1) / CELL_STEPS
            cells[cell, 1] += 0.5 * (old1 + v1) / CELL_STEPS
            cells[cell, 2] += 0.5 * (fine2[place - 1] + x2) / CELL_STEPS
            cells[cell, 3] += 0.5 * (old2 + v2) / CELL_STEPS
            cells[cell, 4] += drive1 / CELL_STEPS
            cells[cell, 5] += drive2 / CELL_STEPS
            cells[cell, 6] += direction1 / CELL_STEPS
            cells[cell, 7] += direction2 / CELL_STEPS
        if not (abs(x1) < 10.0 and abs(x2) < 10.0):
            samples[k:, :] = np.nan
            return samples, cells, marks, errors
    return samples, cells, marks, errors
