// What samples mean, and when a scope begins to hold: pure. A sample is a row with the columns of `COLUMN`.

export const COLUMN = {
  t_s: 0, end_position_m: 1, macro_position_m: 2, setpoint_position_m: 3, error_m: 4, relative_position_m: 5,
  macro_force_n: 6, micro_force_n: 7, contact_force_estimate_n: 8, phase: 9,
};

// A set-point that creeps less than this from one sample to the next doesn't turn.
export const STILL_M = 1e-8;

export const PRE_SHARE = 0.25;

// Where the joint closes, in end minus macro. The service gives its edges as distances in macro minus end.
export function jointEdges_m(backlash) {
  return [-backlash.right_m, backlash.left_m];
}

function rises(rows, at, column, level) {
  const before = rows[at - 1][column];
  const now = rows[at][column];
  return before !== null && now !== null && Math.abs(before) < level && Math.abs(now) >= level;
}

// Direction of the set-point at a sample, looking back over standstill: -1, 0 (never moved) or 1.
function directionBefore(rows, at) {
  for (let place = at; place > 0; place -= 1) {
    const before = rows[place - 1][COLUMN.setpoint_position_m];
    const now = rows[place][COLUMN.setpoint_position_m];
    if (before === null || now === null) return 0;
    if (Math.abs(now - before) > STILL_M) return Math.sign(now - before);
  }
  return 0;
}

function reverses(rows, at) {
  const before = rows[at - 1][COLUMN.setpoint_position_m];
  const now = rows[at][COLUMN.setpoint_position_m];
  if (before === null || now === null || Math.abs(now - before) <= STILL_M) return false;
  return directionBefore(rows, at - 1) === -Math.sign(now - before);
}

// The first sample from `from` on at which the trigger fires, or -1. `level` in SI units; a reversal needs none.
export function firstTrigger(rows, from, kind, level) {
  for (let at = Math.max(from, 1); at < rows.length; at += 1) {
    const fires = kind === 'error' ? rises(rows, at, COLUMN.error_m, level)
      : kind === 'contact' ? rises(rows, at, COLUMN.contact_force_estimate_n, level)
        : kind === 'reversal' && reverses(rows, at);
    if (fires) return at;
  }
  return -1;
}
