// The live page: one stream in, numbers, rails, scope, log and runs out.

import { COLUMN, jointEdges_m } from './trigger.js';
import { Operator } from './operate.js';
import { meaning } from './permit.js';
import { Scope } from './scope.js';

const SILENT_MS = 1500;
const AGAIN_MS = 1000;
const LOG_AGAIN_MS = 2000;
const LOG_LINES = 30;
const RUNS_MOST = 50;
const RUN_CLOSES_MS = 1500; // after a run ended its file is closed

const byId = (id) => document.getElementById(id);
const write = (id, text) => { const place = byId(id); if (place.textContent !== text) place.textContent = text; };
const signed = (text) => text.replace(/^-(?=[0.]*$)/, '').replace('-', '−'); // what rounds to nothing has no sign
const number = (value, scale, digits) => (value === null || value === undefined ? '–' : signed((value * scale).toFixed(digits)));
const twoDigits = (value) => String(value).padStart(2, '0');

// Time of day; the date too where it is not today's.
function clock(at) {
  const when = new Date(at);
  if (Number.isNaN(+when)) return at;
  const time = [when.getHours(), when.getMinutes(), when.getSeconds()].map(twoDigits).join(':');
  if (when.toDateString() === new Date().toDateString()) return time;
  return `${when.getFullYear()}-${twoDigits(when.getMonth() + 1)}-${twoDigits(when.getDate())} ${time}`;
}

let stream = null;
const operator = new Operator((token) => { if (stream?.readyState === WebSocket.OPEN) stream.send(token); });
let scope = null;
let heardAt = performance.now();
let missedAtFirst = null;
let lastRun = '';

// ---- status and samples -------------------------------------------------------------------------------------------

function showLost(text) {
  byId('lost').hidden = !text;
  write('lost', text ? `${text} What is shown is old. To stop the stage now, use its emergency stop.` : '');
  document.body.classList.toggle('stale', Boolean(text));
  if (text) {
    byId('state').dataset.state = 'lost';
    write('state', 'no connection');
    operator.lost();
    write('doing', '');
  }
}

function showRail(id, low, high, value, others = {}) {
  const share = (one) => `${Math.min(Math.max((one - low) / (high - low), 0), 1) * 100}%`;
  const mark = byId(id).querySelector('.mark');
  mark.hidden = value === null;
  if (value !== null) mark.style.left = share(value);
  const { target, gap } = others;
  if (target !== undefined) {
    const place = byId(id).querySelector('.target');
    place.hidden = target === null;
    if (target !== null) place.style.left = share(target);
  }
  if (gap) {
    const place = byId(id).querySelector('.gap');
    place.style.left = share(gap[0]);
    place.style.right = `calc(100% - ${share(gap[1])})`;
  }
}

function showPositions(status) {
  const { positions, limits } = status;
  const backlash = status.wear ?? status.backlash;
  write('end', number(positions.end_position_m, 1e3, 4));
  write('setpoint', number(positions.setpoint_position_m, 1e3, 4));
  write('macro', number(positions.macro_position_m, 1e3, 4));
  write('relative', number(positions.relative_position_m, 1e6, 2));
  if (limits) {
    const [low, high] = limits.travel_m;
    showRail('travel', low, high, status.homed ? positions.end_position_m : null, { target: positions.setpoint_position_m });
    write('travel-low', signed(`${+(low * 1e3).toFixed(3)}`));
    write('travel-high', `${signed(`${+(high * 1e3).toFixed(3)}`)} mm`);
    document.body.classList.toggle('no-micro', !limits.has_micro);
  }
  byId('joint').hidden = !backlash;
  if (!backlash) {
    write('joint-text', 'not identified yet');
    write('joint-low', '');
    write('joint-high', '');
  } else {
    const room = backlash.width_m * 0.3;
    const [low, high] = jointEdges_m(backlash);
    const at = positions.relative_position_m;
    showRail('joint', low - room, high + room, at, { gap: [low, high] });
    const nearest = at === null ? null : Math.min(at - low, high - at);
    const inContact = nearest !== null && nearest <= 0;
    byId('joint').classList.toggle('contact', inContact);
    write('joint-text', nearest === null ? '' : inContact ? `in contact, ${number(-nearest, 1e6, 2)} µm pressed` : `${number(nearest, 1e6, 1)} µm to the next edge`);
    write('joint-low', `edges at ${number(low, 1e6, 1)}`);
    write('joint-high', `and ${number(high, 1e6, 1)} µm`);
  }
}

function showHealth(status) {
  const { health, backlash, recording } = status;
  if (status.state !== 'off') missedAtFirst ??= health.missed_cycles_count;
  if (health.missed_cycles_count < missedAtFirst) missedAtFirst = 0;
  write('cycles', health.cycles_count.toLocaleString('en'));
  write('rate', `${health.rate_hz.toFixed(0)} Hz`);
  write('missed', health.missed_cycles_count.toLocaleString('en'));
  write('missed-since', `${health.missed_cycles_count - (missedAtFirst ?? 0)} since this page opened`);
  write('late', health.lateness_p99_s === null ? '–' : `${number(health.lateness_p99_s, 1e6, 0)} µs`);
  write('late-max', health.lateness_max_s === null ? '' : `greatest ${number(health.lateness_max_s, 1e6, 0)} µs`);
  write('lost-samples', health.lost_samples_count.toLocaleString('en'));
  write('discarded', `${health.discarded_bytes_count.toLocaleString('en')} bytes discarded`);
  showJoint(status.wear ?? backlash, status.wear);
  write('recording', recording?.run ? `${recording.rows_count.toLocaleString('en')} rows` : 'last seconds');
  write('recording-run', recording?.trouble || recording?.run || 'in memory');
  byId('recording-tile').classList.toggle('bad', Boolean(recording?.trouble));
}

// `joint`: what is known of it now, or was identified once; `wear`: null where nobody follows it.
function showJoint(joint, wear) {
  const sd = joint?.width_sd_m ? ` ± ${number(2 * joint.width_sd_m, 1e6, 2)}` : '';
  write('backlash', joint ? `${number(joint.width_m, 1e6, 2)}${sd} µm` : '–');
  write('backlash-at', joint ? `${wear?.source ?? 'identified'} ${joint.at.slice(0, 16).replace('T', ' ')} UTC` : 'not identified');
  write('backlash-age', wear?.text ?? '');
  byId('backlash-tile').classList.toggle('bad', Boolean(wear?.alarm));
  byId('wear').hidden = !wear?.alarm;
  write('wear', wear?.alarm ?? '');
}

function showTemperatures(temperatures) {
  const all = Object.entries(temperatures);
  byId('temperature-tile').hidden = all.length === 0;
  if (!all.length) return;
  const hottest = Math.max(...all.map(([, one]) => one.degc));
  const warned = all.filter(([, one]) => one.warning).map(([axis]) => axis);
  write('temperature', `${number(hottest, 1, 1)} °C`);
  write('temperatures', warned.length ? `warning: ${warned.join(', ')}` : all.map(([axis, one]) => `${axis} ${number(one.degc, 1, 1)}`).join(', '));
  byId('temperature-tile').classList.toggle('bad', warned.length > 0);
}

function showFault(fault) {
  byId('fault').hidden = !fault;
  if (!fault) return;
  write('fault-what', `${fault.what}:`);
  write('fault-values', fault.values);
  write('fault-remedy', `What to do: ${fault.remedy}.`);
  write('fault-at', `${fault.kind}, fault ${fault.number}, ${clock(fault.at)}, while ${fault.state}`);
}

function showStatus(status) {
  byId('state').dataset.state = status.state;
  write('state', status.state);
  write('profile', status.profile);
  write('banner', status.banner);
  byId('banner').dataset.backend = status.backend;
  const powered = !['off', 'idle', 'fault'].includes(status.state);
  write('error', powered ? number(status.positions.error_m, 1e6, 3) : '–'); // without power nothing is followed
  document.title = `${status.state} – ${status.profile}`;
  showPositions(status);
  showHealth(status);
  showTemperatures(status.temperatures ?? {});
  showFault(status.fault);
  operator.update(status);
  write('doing', meaning(operator.situation));
  byId('doing').dataset.homed = status.homed;
  const { end_position_m: end, sample_age_s: age } = status.positions;
  const stale = end === null && age !== null ? [`positions are not known: the interferometer's newest sample is ${age.toFixed(1)} s old`] : [];
  const remarks = [...stale, ...status.remarks];
  write('remarks', remarks.join('\n'));
  byId('remarks').hidden = remarks.length === 0;
  const run = status.recording?.run ?? '';
  if (run !== lastRun) setTimeout(showRuns, RUN_CLOSES_MS);
  lastRun = run;
}

function take(message) {
  if (message.lost) { showLost(message.lost); return; }
  heardAt = performance.now();
  showLost('');
  const { status, samples } = message;
  scope.setStage(status.limits?.has_micro ?? true, status.wear ?? status.backlash);
  scope.add(samples.rows);
  const newest = scope.rows.at(-1);
  if (newest) {
    write('macro-force', number(newest[COLUMN.macro_force_n], 1, 2));
    write('micro-force', number(newest[COLUMN.micro_force_n], 1, 3));
    write('contact', number(newest[COLUMN.contact_force_estimate_n], 1, 3));
  }
  showStatus(status);
}

function listen() {
  stream = new WebSocket(`ws://${location.host}/v1/stream`);
  stream.onopen = () => stream.send(operator.token);
  stream.onmessage = (event) => take(JSON.parse(event.data));
  stream.onclose = async () => {
    const answer = await fetch('/session').catch(() => null);
    const stranger = answer?.status === 401 ? await answer.json().catch(() => null) : null;
    showLost(stranger ? `This page is not known any more: ${stranger.message}.` : 'The page\'s process is gone, or let go of this page.');
    setTimeout(listen, AGAIN_MS);
  };
}

setInterval(() => {
  if (performance.now() - heardAt > SILENT_MS) showLost(byId('lost').textContent ? byId('lost').textContent.split(' What is shown')[0] : 'Nothing is heard from the service.');
}, 500);

// ---- log and runs -------------------------------------------------------------------------------------------------

async function showLog() {
  if (document.hidden) return;
  const answer = await fetch(`/v1/log?limit=${LOG_LINES}`).catch(() => null);
  if (!answer?.ok) return;
  const entries = await answer.json();
  const newest = String(entries.at(-1)?.number ?? '');
  if (byId('log').dataset.newest === newest) return;
  byId('log').dataset.newest = newest;
  byId('log').replaceChildren(...entries.reverse().map((entry) => {
    const item = document.createElement('li');
    const time = document.createElement('time');
    time.textContent = clock(entry.at);
    const what = document.createElement('b');
    what.textContent = entry.event === 'state' ? `${entry.fields.before} → ${entry.fields.state}` : entry.event.replaceAll('_', ' ');
    const of = entry.event.startsWith('command_') ? `${entry.fields.name}: ` : '';
    item.append(time, ' ', what, ` ${of}${entry.text}`);
    return item;
  }));
}

function runRow(run) {
  const row = document.createElement('tr');
  const cell = (text, name = '') => { const made = document.createElement('td'); made.textContent = text; made.className = name; row.append(made); return made; };
  const link = document.createElement('a');
  link.href = `/runs/${encodeURIComponent(run.name)}/report`;
  link.target = '_blank';
  link.rel = 'noopener';
  link.title = 'report';
  link.textContent = run.name;
  cell('', 'name').append(link);
  cell(run.state).dataset.state = run.state;
  cell(`${run.duration_s.toFixed(1)} s`, 'n');
  cell(run.text || run.stop, 'text');
  return row;
}

async function showRuns() {
  write('runs-note', 'reads');
  const answer = await fetch('/v1/runs').catch(() => null);
  const runs = answer?.ok ? await answer.json() : null;
  if (!runs) { write('runs-note', 'can\'t be read now'); return; }
  byId('runs').tBodies[0].replaceChildren(...runs.slice(-RUNS_MOST).reverse().map(runRow));
  write('runs-note', runs.length ? `${runs.length} in all; a name opens its report, drawn when it is first asked for` : 'none yet');
}

// Asked until it is answered: an operator's page must not stay without STOP because one answer got lost.
async function askRole() {
  const answer = await fetch('/session').catch(() => null);
  const found = answer?.ok ? await answer.json().catch(() => null) : null;
  if (!found) { setTimeout(askRole, AGAIN_MS); return; }
  operator.setRole(found.role);
  operator.show();
}

function begin() {
  scope = new Scope(byId('plots'));
  askRole();
  listen();
  showRuns();
  showLog();
  setInterval(showLog, LOG_AGAIN_MS);
  byId('runs-refresh').addEventListener('click', showRuns);
}

begin();
