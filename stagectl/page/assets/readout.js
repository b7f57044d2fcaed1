// What two cursors on the scope say: pure. Rows are samples with the columns of `COLUMN`, oldest first.

import { COLUMN } from './trigger.js';

export const QUANTITIES = [
  { label: 'end, mm', column: COLUMN.end_position_m, scale: 1e3, digits: 5 },
  { label: 'error, µm', column: COLUMN.error_m, scale: 1e6, digits: 3 },
  { label: 'micro to macro, µm', column: COLUMN.relative_position_m, scale: 1e6, digits: 3, micro: true },
  { label: 'macro, N', column: COLUMN.macro_force_n, scale: 1, digits: 2 },
  { label: 'micro, N', column: COLUMN.micro_force_n, scale: 1, digits: 3, micro: true },
  { label: 'contact, N', column: COLUMN.contact_force_estimate_n, scale: 1, digits: 3, micro: true },
];

// The sample nearest to a time, or null where there is none.
export function nearest(rows, t_s) {
  if (!rows.length) return null;
  let low = 0;
  let high = rows.length - 1;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (rows[middle][0] < t_s) low = middle + 1; else high = middle;
  }
  return low > 0 && t_s - rows[low - 1][0] < rows[low][0] - t_s ? rows[low - 1] : rows[low];
}

const known = (values) => values.filter((value) => value !== null);
const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;

const STATISTICS = {
  mean,
  'rms about mean': (values) => { const middle = mean(values); return Math.sqrt(mean(values.map((value) => (value - middle) ** 2))); },
  'peak to peak': (values) => values.reduce((most, value) => Math.max(most, value), -Infinity) - values.reduce((least, value) => Math.min(least, value), Infinity),
};

// A value of each quantity in its unit: {name, t_s, values}, null where it is not known. `a_s`, `b_s` null: not placed.
export function readout(rows, a_s, b_s) {
  const lines = [];
  const at = { A: a_s === null ? null : nearest(rows, a_s), B: b_s === null ? null : nearest(rows, b_s) };
  for (const [name, row] of Object.entries(at)) {
    if (row) lines.push({ name, t_s: row[0], values: QUANTITIES.map(({ column, scale }) => (row[column] === null ? null : row[column] * scale)) });
  }
  if (lines.length < 2) return lines;
  const [a, b] = lines;
  const dt_s = b.t_s - a.t_s;
  const apart = a.values.map((value, place) => (value === null || b.values[place] === null ? null : b.values[place] - value));
  lines.push({ name: 'B − A', t_s: dt_s, values: apart });
  if (dt_s !== 0) lines.push({ name: 'per second', t_s: null, values: apart.map((value) => (value === null ? null : value / dt_s)) });
  const between = rows.filter((row) => row[0] >= Math.min(a.t_s, b.t_s) && row[0] <= Math.max(a.t_s, b.t_s));
  for (const [name, statistic] of Object.entries(STATISTICS)) {
    lines.push({ name, t_s: null, values: QUANTITIES.map(({ column, scale }) => {
      const values = known(between.map((row) => row[column]));
      return values.length ? statistic(values) * scale : null;
    }) });
  }
  return lines;
}
