// The scope: four plots over one time, that roll, hold where a trigger fired, and zoom together.

import { QUANTITIES, readout } from './readout.js';
import { COLUMN, PRE_SHARE, firstTrigger, jointEdges_m } from './trigger.js';

const KEPT_COUNT = 6000;
const AGAIN_S = 1.0; // how long a shot stays at least, where the trigger fires again and again
const LEVELS = { error: { unit: 'µm', si: 1e-6, usual: 5 }, contact: { unit: 'N', si: 1, usual: 1 } };

const line = (label, column, colour, scale, extra = {}) => ({ label, column, colour, scale, ...extra });
const PLOTS = [
  { title: 'position, mm', height: 150, least: 2e-3, lines: [
    line('set-point', COLUMN.setpoint_position_m, 'setpoint', 1e3, { dash: [6, 4] }),
    line('macro', COLUMN.macro_position_m, 'macro', 1e3), line('end', COLUMN.end_position_m, 'end', 1e3)] },
  { title: 'error, µm', height: 150, least: 0.02, lines: [line('error', COLUMN.error_m, 'error', 1e6)], zero: true },
  { title: 'micro to macro, µm', height: 120, least: 0.02, micro: true, lines: [
    line('micro to macro', COLUMN.relative_position_m, 'micro', 1e6)], edges: true },
  { title: 'force, N', height: 150, least: 0.2, zero: true, lines: [
    line('macro', COLUMN.macro_force_n, 'macro', 1), line('micro', COLUMN.micro_force_n, 'micro', 1, { micro: true }),
    line('contact', COLUMN.contact_force_estimate_n, 'contact', 1, { micro: true })] },
];

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const byId = (id) => document.getElementById(id);

export class Scope {
  constructor(place) {
    this.place = place;
    this.rows = [];
    this.columns = Object.keys(COLUMN);
    this.count = 0; // of all samples ever taken: the place of a sample is its number
    this.shown = null; // a shot that is held: {rows, zero_s, text}
    this.zoom = null; // [from, to] in seconds of the time axis
    this.cursors = null; // {A, B} on the time axis, null where not placed; null: no cursors
    this.fired = null; // {number, t_s}: waits for the rest of its window
    this.searched = 0;
    this.shotAt_s = -Infinity;
    this.edges = null;
    this.hasMicro = true;
    this.dirty = true;
    this.build();
    this.hearTools();
    new ResizeObserver(() => this.resize()).observe(place);
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => this.build());
    const frame = () => { if (this.dirty) this.draw(); requestAnimationFrame(frame); };
    requestAnimationFrame(frame);
  }

  get window_s() { return Number(byId('window').value); }
  get kind() { return byId('trigger').value; }
  get level() { return Number(byId('level').value) * (LEVELS[this.kind]?.si ?? 1); }

  // ---- samples ----

  add(rows) {
    if (rows.length && this.rows.length && rows[0][0] <= this.rows.at(-1)[0]) this.clear();
    this.rows.push(...rows);
    this.count += rows.length;
    if (this.rows.length > KEPT_COUNT) this.rows.splice(0, this.rows.length - KEPT_COUNT);
    this.lookForTrigger();
    if (!this.shown) this.dirty = true;
  }

  clear() {
    this.rows = [];
    this.fired = null;
    this.searched = this.count;
  }

  setStage(hasMicro, backlash) {
    const edges = backlash ? jointEdges_m(backlash) : null;
    if (JSON.stringify(edges) !== JSON.stringify(this.edges)) { this.edges = edges; this.dirty = true; }
    if (hasMicro !== this.hasMicro) { this.hasMicro = hasMicro; this.build(); }
  }

  // ---- trigger ----

  rearm() {
    this.fired = null;
    this.searched = this.count;
    this.release();
  }

  release() {
    this.shown = null;
    this.zoom = null;
    if (this.cursors) this.cursors = { A: null, B: null };
    this.dirty = true;
    this.say();
  }

  lookForTrigger() {
    if (this.kind === 'none' || (this.shown && (this.shown.byHand || byId('single').checked || this.zoom))) return;
    const first = this.count - this.rows.length;
    if (!this.fired && performance.now() / 1e3 - this.shotAt_s >= AGAIN_S) {
      const at = firstTrigger(this.rows, Math.max(this.searched - first, 1), this.kind, this.level);
      if (at >= 0) this.fired = { number: first + at, t_s: this.rows[at][0] };
    }
    this.searched = this.count;
    if (this.fired && this.rows.at(-1)[0] >= this.fired.t_s + (1 - PRE_SHARE) * this.window_s) {
      const from_s = this.fired.t_s - PRE_SHARE * this.window_s;
      const until_s = from_s + this.window_s;
      const rows = this.rows.filter((row) => row[0] >= from_s && row[0] <= until_s);
      this.show(rows, this.fired.t_s, false);
      this.shotAt_s = performance.now() / 1e3;
      this.fired = null;
    }
    this.say();
  }

  show(rows, zero_s, byHand) {
    this.shown = { rows, zero_s, byHand };
    this.dirty = true;
    this.say();
  }

  holdNow() {
    const now_s = this.rows.at(-1)?.[0] ?? 0;
    this.show(this.rows.slice(), now_s, true);
  }

  say() {
    const chip = byId('trigger-state');
    const text = this.shown ? (this.shown.byHand ? 'held' : 'triggered') : this.kind === 'none' ? 'rolling'
      : this.fired ? 'fills the window' : 'waits for the trigger';
    if (chip.textContent !== text) chip.textContent = text;
    chip.dataset.kind = this.shown ? 'held' : this.kind === 'none' ? '' : 'waits';
    const again = this.kind !== 'none' && this.shown;
    byId('hold').textContent = this.shown ? (again ? 'Next' : 'Go on') : 'Hold';
  }

  // ---- drawing ----

  build() {
    for (const plot of this.plots ?? []) plot.destroy();
    this.place.replaceChildren();
    this.layout = PLOTS.filter((one) => this.hasMicro || !one.micro)
      .map((one) => ({ ...one, lines: one.lines.filter((each) => this.hasMicro || !each.micro) }));
    this.plots = this.layout.map((one, place) => new uPlot(this.options(one, place), [[], ...one.lines.map(() => [])], this.place));
    for (const plot of this.plots) this.hearPointer(plot);
    this.dirty = true;
  }

  options(one, place) {
    const last = place === this.layout.length - 1;
    const grid = { stroke: colour('grid'), width: 1 };
    const axis = { stroke: colour('muted'), grid, ticks: grid, font: '11px system-ui' };
    return {
      padding: [8, 18, 0, 0],
      width: Math.max(this.place.clientWidth, 200), height: one.height + (last ? 26 : 0),
      cursor: { sync: { key: 'scope', setSeries: false }, drag: { x: true, y: false, setScale: false }, points: { size: 5 } },
      legend: { live: true },
      scales: { x: { time: false, range: () => this.range() }, y: { range: (plot, low, high) => this.heightOf(one, low, high) } },
      axes: [{ ...axis, size: last ? 30 : 6, values: (plot, marks) => marks.map((mark) => (last ? `${+mark.toFixed(4)} s` : '')) },
        { ...axis, size: 64, label: one.title, labelSize: 16, labelFont: '11px system-ui', labelGap: 0 }],
      series: [{ label: 't, s', value: (plot, value) => (value === null ? '–' : value.toFixed(2)) },
        ...one.lines.map((each) => ({ label: each.label, stroke: colour(each.colour), width: 1.4, dash: each.dash, spanGaps: each.column === COLUMN.error_m,
          points: { show: false }, value: (plot, value) => (value == null ? '–' : value.toFixed(each.scale === 1e3 ? 4 : 3)) }))],
      hooks: {
        setSelect: [(plot) => this.select(plot)],
        draw: [(plot) => this.mark(plot, one)],
        ready: [(plot) => plot.over.addEventListener('dblclick', () => this.resetZoom())],
      },
    };
  }

  heightOf(one, low, high) {
    if (low === null || high === null || !Number.isFinite(low + high)) return [-1, 1];
    if (one.edges && this.edges) { low = Math.min(low, this.edges[0] * 1e6); high = Math.max(high, this.edges[1] * 1e6); }
    if (one.zero) { low = Math.min(low, 0); high = Math.max(high, 0); }
    const room = Math.max((high - low) * 0.08, (one.least - (high - low)) / 2);
    return [low - room, high + room];
  }

  whole() {
    if (!this.shown) return [-this.window_s, 0];
    if (this.shown.byHand) {
      const rows = this.shown.rows;
      const far_s = rows.length ? rows[0][0] - this.shown.zero_s : -this.window_s;
      return [Math.max(far_s, -this.window_s), 0];
    }
    return [-PRE_SHARE * this.window_s, (1 - PRE_SHARE) * this.window_s];
  }

  range() { return this.zoom ?? this.whole(); }

  draw() {
    this.dirty = false;
    const rows = this.shown ? this.shown.rows : this.rows;
    const zero_s = this.shown ? this.shown.zero_s : this.rows.at(-1)?.[0] ?? 0;
    const [from, to] = this.range();
    let first = rows.findIndex((row) => row[0] - zero_s >= from);
    first = Math.max(first - 1, 0);
    let last = rows.length;
    while (last > first && rows[last - 1][0] - zero_s > to) last -= 1;
    const seen = rows.slice(first, Math.min(last + 1, rows.length));
    this.visible = seen;
    const t = seen.map((row) => row[0] - zero_s);
    this.plots.forEach((plot, place) => {
      const lines = this.layout[place].lines;
      plot.setData([t, ...lines.map((each) => seen.map((row) => (row[each.column] === null ? null : row[each.column] * each.scale)))]);
      if (!(plot.cursor.left >= 0)) plot.setLegend({ idx: t.length ? t.length - 1 : null }, false); // no pointer: the newest
    });
    this.showCursors(rows, zero_s);
  }

  mark(plot, one) {
    const { ctx, bbox } = plot;
    ctx.save();
    const stroke = (x0, y0, x1, y1, name, dash) => {
      ctx.strokeStyle = colour(name); ctx.setLineDash(dash); ctx.lineWidth = devicePixelRatio;
      ctx.beginPath(); ctx.moveTo(x0, y0); ctx.lineTo(x1, y1); ctx.stroke();
    };
    const across = (value, name, dash) => {
      const y = plot.valToPos(value, 'y', true);
      if (y >= bbox.top && y <= bbox.top + bbox.height) stroke(bbox.left, y, bbox.left + bbox.width, y, name, dash);
    };
    if (one.edges && this.edges) for (const edge_m of this.edges) across(edge_m * 1e6, 'contact', [5, 5]);
    const guarded = { error: COLUMN.error_m, contact: COLUMN.contact_force_estimate_n }[this.kind];
    if (guarded !== undefined && one.lines.some((each) => each.column === guarded)) {
      const level = this.level * (guarded === COLUMN.error_m ? 1e6 : 1);
      across(level, 'trigger', [2, 4]);
      across(-level, 'trigger', [2, 4]);
    }
    if (this.shown && !this.shown.byHand) {
      const x = plot.valToPos(0, 'x', true);
      if (x >= bbox.left && x <= bbox.left + bbox.width) stroke(x, bbox.top, x, bbox.top + bbox.height, 'trigger', []);
    }
    for (const [name, at_s] of Object.entries(this.cursors ?? {})) {
      const x = at_s === null ? NaN : plot.valToPos(at_s, 'x', true);
      if (!(x >= bbox.left && x <= bbox.left + bbox.width)) continue;
      stroke(x, bbox.top, x, bbox.top + bbox.height, 'accent', [3, 3]);
      ctx.fillStyle = colour('accent');
      ctx.font = `${11 * devicePixelRatio}px system-ui`;
      ctx.fillText(name, x + 3 * devicePixelRatio, bbox.top + 10 * devicePixelRatio);
    }
    ctx.restore();
  }

  // ---- cursors: the first click is A, the second B, a further one moves the nearer ----

  toggleCursors() {
    this.cursors = this.cursors ? null : { A: null, B: null };
    if (this.cursors && !this.shown) this.holdNow();
    byId('cursors-on').setAttribute('aria-pressed', String(Boolean(this.cursors)));
    this.dirty = true;
  }

  placeCursor(at_s) {
    const { A, B } = this.cursors;
    if (!this.shown) this.holdNow();
    const name = A === null ? 'A' : B === null ? 'B' : Math.abs(at_s - A) < Math.abs(at_s - B) ? 'A' : 'B';
    this.cursors[name] = at_s;
    this.dirty = true;
  }

  showCursors(rows, zero_s) {
    const table = byId('cursors');
    table.hidden = !this.cursors;
    if (!this.cursors) return;
    const { A, B } = this.cursors;
    const absolute = (at_s) => (at_s === null ? null : at_s + zero_s);
    const shown = QUANTITIES.map((one, place) => ({ ...one, place })).filter((one) => this.hasMicro || !one.micro);
    const row = (tag, texts) => {
      const made = document.createElement('tr');
      for (const text of texts) { const cell = document.createElement(tag); cell.textContent = text; cell.className = 'n'; made.append(cell); }
      return made;
    };
    const time = (line) => {
      if (line.t_s === null) return '';
      if (line.name !== 'B − A') return `${(line.t_s - zero_s).toFixed(3)} s`;
      return line.t_s === 0 ? '0 s' : `${line.t_s.toFixed(3)} s, ${Math.abs(1 / line.t_s).toPrecision(3)} Hz`;
    };
    const lines = readout(rows, absolute(A), absolute(B));
    const head = row('th', [lines.length ? '' : 'click the plots: A, then B', 'time', ...shown.map((one) => one.label)]);
    const body = lines.map((line) => row('td', [line.name, time(line), ...shown.map((one) => {
      const value = line.values[one.place];
      return value === null ? '–' : value.toFixed(one.digits).replace('-', '−');
    })]));
    table.replaceChildren(head, ...body);
  }

  resize() {
    const width = Math.max(this.place.clientWidth, 200);
    this.plots.forEach((plot) => { if (plot.width !== width) plot.setSize({ width, height: plot.height }); });
  }

  // ---- zoom ----

  zoomTo(from, to) {
    if (!this.shown) this.holdNow();
    const [low, high] = this.whole();
    const width = Math.max(Math.min(to - from, high - low), 0.03);
    const start = Math.min(Math.max(from, low), high - width);
    this.zoom = width >= high - low ? null : [start, start + width];
    this.dirty = true;
    this.say();
  }

  zoomBy(factor, share = 0.5) {
    const [from, to] = this.range();
    const at = from + share * (to - from);
    this.zoomTo(at - (at - from) * factor, at + (to - at) * factor);
  }

  pan(share) {
    const [from, to] = this.range();
    if (this.zoom) this.zoomTo(from + share * (to - from), to + share * (to - from));
  }

  resetZoom() { this.zoom = null; this.dirty = true; this.say(); }

  select(plot) {
    const { left, width } = plot.select;
    if (width < 4) return;
    const [from, to] = [plot.posToVal(left, 'x'), plot.posToVal(left + width, 'x')];
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.zoomTo(from, to);
  }

  hearPointer(plot) {
    let downAt = 0;
    plot.over.addEventListener('mousedown', (event) => { downAt = event.clientX; });
    plot.over.addEventListener('click', (event) => {
      if (this.cursors && Math.abs(event.clientX - downAt) < 4) this.placeCursor(plot.posToVal(event.offsetX, 'x'));
    });
    plot.over.addEventListener('wheel', (event) => {
      event.preventDefault();
      const sideways = event.shiftKey ? event.deltaY : Math.abs(event.deltaX) > Math.abs(event.deltaY) ? event.deltaX : 0;
      if (sideways) { this.pan(Math.sign(sideways) * 0.1); return; }
      this.zoomBy(event.deltaY < 0 ? 0.8 : 1.25, event.offsetX / plot.over.clientWidth);
    }, { passive: false });
  }

  hearTools() {
    byId('window').addEventListener('change', () => { this.zoom = null; if (!this.shown?.byHand) this.rearm(); this.dirty = true; });
    byId('trigger').addEventListener('change', () => {
      const level = LEVELS[this.kind];
      byId('level-label').hidden = !level;
      byId('single-label').hidden = this.kind === 'none';
      if (level) { byId('level').value = level.usual; byId('level-unit').textContent = level.unit; }
      this.rearm();
    });
    byId('level').addEventListener('change', () => this.rearm());
    byId('single').addEventListener('change', () => this.rearm());
    byId('hold').addEventListener('click', () => (this.shown ? this.rearm() : this.holdNow()));
    byId('zoom-in').addEventListener('click', () => this.zoomBy(0.5));
    byId('zoom-out').addEventListener('click', () => this.zoomBy(2));
    byId('zoom-reset').addEventListener('click', () => this.resetZoom());
    byId('cursors-on').addEventListener('click', () => this.toggleCursors());
    byId('save').addEventListener('click', () => this.save());
  }

  save() {
    const lines = [this.columns.join(','), ...(this.visible ?? []).map((row) => row.map((value) => value ?? '').join(','))];
    const link = document.createElement('a');
    link.href = URL.createObjectURL(new Blob([lines.join('\n') + '\n'], { type: 'text/csv' }));
    link.download = 'scope.csv';
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }
}
