// What samples mean, and when a scope begins to hold: pure. A sample is a row with the columns of `COLUMN`.

export const COLUMN = {
  t_s: 0, end_position_m: 1, macro_position_m: 2, setpoint_position_m: 3, error_m: 4, relative_position_m: 5,
  macro_force_n: 6, micro_force_n: 7, contact_force_estimate_n: 8, phase: 9,
};

// A set-point that creeps less than this from one sample to the next doesn't turn.
export const STILL_M = 1e-8;

export const PRE_SHARE = 0.25;

// Phases in which the servo follows a set-point: TICKING of stagectl/requests.py. Without power the error means nothing.
export const TICKING = [4, 5, 8];

// Where the joint closes, in end minus macro. The service gives its edges as distances in macro minus end.
export function jointEdges_m(backlash) {
  return [-backlash.right_m, backlash.left_m];
}

const isWorking = (row) => TICKING.includes(row[COLUMN.phase]);

// Whether a value is at its level or beyond; null where that isn't known: behind a late line there is no error.
function isBeyond(row, column, level) {
  if (!isWorking(row)) return false;
  return row[column] === null ? null : Math.abs(row[column]) >= level;
}

// As the service's own trigger: what isn't known begins and ends nothing, and what holds from the start is no rise.
function firstRise(rows, from, column, level) {
  let held = null;
  for (let at = from - 1; at >= 0 && held === null; at -= 1) held = isBeyond(rows[at], column, level);
  held ??= true;
  for (let at = from; at < rows.length; at += 1) {
    const now = isBeyond(rows[at], column, level);
    if (now && !held) return at;
    held = now ?? held;
  }
  return -1;
}

// Direction of the set-point at a sample, looking back over standstill: -1, 0 (never moved) or 1.
function directionBefore(rows, at) {
  for (let place = at; place > 0; place -= 1) {
    if (!isWorking(rows[place - 1])) return 0;
    const before = rows[place - 1][COLUMN.setpoint_position_m];
    const now = rows[place][COLUMN.setpoint_position_m];
    if (before === null || now === null) return 0;
    if (Math.abs(now - before) > STILL_M) return Math.sign(now - before);
  }
  return 0;
}

function reverses(rows, at) {
  if (!isWorking(rows[at - 1]) || !isWorking(rows[at])) return false;
  const before = rows[at - 1][COLUMN.setpoint_position_m];
  const now = rows[at][COLUMN.setpoint_position_m];
  if (before === null || now === null || Math.abs(now - before) <= STILL_M) return false;
  return directionBefore(rows, at - 1) === -Math.sign(now - before);
}

// The first sample from `from` on at which the trigger fires, or -1. `level` in SI units; a reversal needs none.
export function firstTrigger(rows, from, kind, level) {
  const begin = Math.max(from, 1);
  if (kind === 'error') return firstRise(rows, begin, COLUMN.error_m, level);
  if (kind === 'contact') return firstRise(rows, begin, COLUMN.contact_force_estimate_n, level);
  for (let at = begin; kind === 'reversal' && at < rows.length; at += 1) if (reverses(rows, at)) return at;
  return -1;
}
