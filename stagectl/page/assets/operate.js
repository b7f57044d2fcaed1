// What an operator does: the lease with its renewals, commands, hold-to-move jog, and STOP.

import { BUTTONS, isPowered, whyNot } from './permit.js';
import { key } from './key.js';

const LEASE_S = 3.0; // a page that draws much may be late; a jog has its own, shorter hold
const JOG_HOLD_S = 0.3;
const JOG_AGAIN_MS = 90;
const STOP_AGAIN_MS = 250;
const STOP_TRIES = 12;
const ALARM_MS = 5000;
const OVER = ['done', 'failed'];

const byId = (id) => document.getElementById(id);
const sleep = (ms) => new Promise((resolve) => { setTimeout(resolve, ms); });

export class Operator {
  #token = '';

  // `say` tells the page's process which lease this page holds: it gives the lease back when the page is gone.
  constructor(say) {
    this.say = say;
    this.status = null;
    this.mayOperate = null; // until the page's process has said
    this.unanswered = null; // the press that nobody answered: {what, pressKey}
    this.renewedAt = 0;
    this.renewing = false;
    this.jog = 0; // direction that is held now
    this.jogging = false;
    this.told = null; // the newest command, and what became of it
    this.following = false;
    this.stopping = false;
    this.hear();
  }

  setRole(role) {
    this.mayOperate = role === 'operate';
    byId('commands').hidden = !this.mayOperate;
    byId('watching').hidden = this.mayOperate;
    byId('stop').disabled = !this.mayOperate;
    if (!this.mayOperate) {
      byId('stop').title = 'This page may only watch. Use `stagectl stop` or the emergency stop.';
      byId('stop').textContent = 'STOP: not from here';
    }
  }

  // ---- talking ----

  async ask(method, path, body, more = {}, moreHeaders = {}) {
    const headers = { ...moreHeaders, 'Stagectl-Page': key, ...(this.token ? { 'Stagectl-Lease': this.token } : {}), ...(body === undefined ? {} : { 'Content-Type': 'application/json' }) };
    let answer;
    try {
      answer = await fetch(`/v1/${path}`, { method, headers, body: body === undefined ? undefined : JSON.stringify(body), ...more });
    } catch {
      throw new Error('The page\'s process doesn\'t answer; is `stagectl page` still running?');
    }
    const found = answer.status === 204 ? null : await answer.json().catch(() => null);
    if (!answer.ok) throw Object.assign(new Error(found?.message ?? `answered ${answer.status}`), { code: answer.status, kind: found?.kind });
    return found;
  }

  // What is done once a press. A press without an answer may have been heard: the same press again sends its key again,
  // and the service then tells what became of the first in place of doing it twice.
  async press(method, path, body) {
    const what = JSON.stringify([method, path, body]);
    const pressKey = this.unanswered?.what === what ? this.unanswered.pressKey : `page-${crypto.randomUUID()}`;
    try {
      const found = await this.ask(method, path, body, {}, { 'Idempotency-Key': pressKey });
      this.unanswered = null;
      return found;
    } catch (error) {
      this.unanswered = error.code === undefined || error.code === 502 ? { what, pressKey } : null;
      if (this.unanswered) error.message += ' It may have been heard; pressed again, it is not done twice.';
      throw error;
    }
  }

  async command(path, body, method = 'POST') {
    this.refuse('');
    try { this.follow(await this.press(method, path, body)); } catch (error) { this.refuse(error.message); }
  }

  // What the service took is shown from its answer on: a motion can be over before the next status is sent.
  follow(taken) {
    if (!taken?.key) return; // a run that was begun or ended by hand is no command with an end of its own
    this.told = taken;
    this.showCommand();
  }

  refuse(text) {
    byId('refusal').hidden = !text;
    byId('refusal').textContent = text;
  }

  // ---- the lease: renewed as the stream comes, so that a page that hears nothing moves nothing ----

  async takeOrGive() {
    this.refuse('');
    try {
      if (this.token) {
        await this.press('DELETE', 'lease');
        this.token = '';
      } else {
        const taken = await this.press('POST', 'lease', { holder: 'the live page', duration_s: LEASE_S });
        this.token = taken.token;
        this.renewedAt = performance.now();
      }
    } catch (error) { this.token = ''; this.refuse(error.message); }
    this.show();
  }

  async renew() {
    if (!this.token || this.renewing || performance.now() - this.renewedAt < LEASE_S * 1e3 / 6) return;
    this.renewing = true;
    const token = this.token;
    try {
      await this.ask('PUT', 'lease');
      this.renewedAt = performance.now();
    } catch (error) {
      if (error.code && error.code !== 502 && token === this.token) { this.token = ''; this.refuse(error.message); }
    } finally { this.renewing = false; }
  }

  get token() { return this.#token; }

  set token(token) {
    this.#token = token;
    this.say(token);
  }

  // ---- jog: said again and again while it is held; the service lets go by itself when it isn't, and what comes late
  // begins nothing: a jog begins at rest, and a velocity counts only in the jog that it was said to ----

  speed_m_per_s() {
    const most = this.status?.limits?.jog_velocity_m_per_s ?? 0.1;
    return most * 10 ** ((Number(byId('jog-speed').value) - 100) / 33.3);
  }

  async holdJog(direction) {
    if (whyNot('jog-left', this.situation)) return;
    this.jog = direction;
    this.showJog();
    if (this.jogging) return;
    this.jogging = true;
    this.refuse('');
    let begun = '';
    try {
      while (this.jog !== 0) {
        if (!begun) {
          const taken = await this.ask('POST', 'jogging', { hold_s: JOG_HOLD_S });
          this.follow(taken);
          begun = taken.key;
        }
        if (this.jog !== 0 && !await this.goOn(begun, this.jog * this.speed_m_per_s())) begun = '';
        await sleep(JOG_AGAIN_MS);
      }
      if (begun) await this.goOn(begun, 0);
    } catch (error) {
      if (this.jog !== 0) this.refuse(error.message);
      this.jog = 0;
    } finally {
      this.jogging = false;
      this.showJog();
    }
  }

  // Whether that jog is still under way.
  async goOn(begun, velocity_m_per_s) {
    try {
      await this.ask('PUT', `jogging/${begun}`, { velocity_m_per_s, hold_s: velocity_m_per_s === 0 ? 0.05 : JOG_HOLD_S });
      return true;
    } catch (error) {
      if (error.kind === 'JogOver') return false;
      throw error;
    }
  }

  letGo() { this.jog = 0; this.showJog(); }

  showJog() {
    byId('jog-left').classList.toggle('held', this.jog < 0);
    byId('jog-right').classList.toggle('held', this.jog > 0);
  }

  // ---- stop: said again until the service has heard it ----

  async stop() {
    this.jog = 0;
    if (this.mayOperate === false) {
      this.alarm('STOP was not sent: this page may only watch. Use `stagectl stop` or the emergency stop.');
      setTimeout(() => this.alarm(''), ALARM_MS);
      return;
    }
    if (this.stopping) return;
    this.stopping = true;
    byId('stop').classList.add('pressed');
    this.refuse('');
    try {
      for (let left = STOP_TRIES; left > 0; left -= 1) {
        try {
          await this.ask('POST', 'stop', undefined, { signal: AbortSignal.timeout(4 * STOP_AGAIN_MS) });
          this.alarm('');
          return;
        } catch (error) { this.alarm(`STOP was not heard: ${error.message} Use the emergency stop.`); }
        await sleep(STOP_AGAIN_MS);
      }
    } finally {
      this.stopping = false;
      byId('stop').classList.remove('pressed');
    }
  }

  alarm(text) {
    byId('alarm').hidden = !text;
    byId('alarm').textContent = text;
  }

  // ---- what can be done now ----

  get state() { return this.status?.state ?? ''; }

  get situation() {
    return { status: this.status, held: Boolean(this.token), mayOperate: this.mayOperate, jogging: this.jogging };
  }

  update(status) {
    this.status = status;
    if (this.token && !status.lease && performance.now() - this.renewedAt > 2 * LEASE_S * 1e3) this.token = '';
    if (this.mayOperate && !this.stopping && !isPowered(status.state)) this.alarm('');
    this.renew();
    this.followCommand(status.command);
    this.show();
  }

  lost() { this.status = null; this.letGo(); this.show(); }

  show() {
    const held = Boolean(this.token);
    const { status, situation } = this;
    for (const id of BUTTONS) {
      const why = whyNot(id, situation);
      const button = byId(id);
      if (button.title !== why) button.title = why;
      const disabled = why ? 'true' : 'false'; // it still says why when it is pressed
      if (button.getAttribute('aria-disabled') !== disabled) button.setAttribute('aria-disabled', disabled);
    }
    byId('take').textContent = held ? 'Give the lease back' : 'Take the lease';
    byId('take').classList.toggle('primary', !held);
    const chip = byId('lease');
    chip.textContent = held ? 'this page operates' : status?.lease ? `${status.lease.holder} operates` : 'nobody operates';
    chip.dataset.kind = held ? 'ours' : status?.lease ? 'other' : '';
    if (status?.limits) {
      const [low_m, high_m] = status.limits.travel_m;
      byId('move-range').textContent = `${+(low_m * 1e3).toFixed(3)} to ${+(high_m * 1e3).toFixed(3)} mm`.replaceAll('-', '−');
    }
    const speed = this.speed_m_per_s() * 1e3;
    byId('jog-speed-text').textContent = `${speed < 1 ? speed.toFixed(2) : speed.toPrecision(3)} mm/s`;
    this.showCommand();
  }

  // A command leaves the status with its end; what became of it is asked for by its key.
  async followCommand(found) {
    const before = this.told;
    if (found) this.told = found;
    if (found || !before || OVER.includes(before.state) || this.following) return;
    this.following = true;
    try {
      const ended = await this.ask('GET', `commands/${encodeURIComponent(before.key)}`);
      if (this.told === before) { this.told = ended; this.showCommand(); }
    } catch { /* asked again with the next status */ } finally { this.following = false; }
  }

  showCommand() {
    const command = this.told;
    byId('command').hidden = !command;
    if (!command) return;
    const finished = command.stop === 'FINISHED';
    const end = { waiting: 'waits', running: '', done: finished || !command.stop ? 'done' : `ended by ${command.stop}`, failed: 'failed' }[command.state];
    const text = finished ? this.found(command.backlash) : command.text;
    byId('command-text').textContent = [command.name, end, text].filter(Boolean).join(': ');
    byId('command').dataset.state = command.state;
    byId('command-share').hidden = command.state !== 'running';
    if (command.share > 0) byId('command-share').value = command.share; else byId('command-share').removeAttribute('value');
  }

  found(backlash) {
    if (!backlash) return '';
    const sd = backlash.width_sd_m === null ? '' : ` ± ${(2e6 * backlash.width_sd_m).toFixed(2)}`;
    return `backlash ${(1e6 * backlash.width_m).toFixed(2)}${sd} µm (95 %)`;
  }

  // An action of a button, or why it can't be taken now.
  on(id, act) {
    byId(id).addEventListener('click', () => {
      const why = whyNot(id, this.situation);
      if (why) this.refuse(`${byId(id).dataset.name ?? byId(id).firstChild.textContent}: ${why}`); else act();
    });
  }

  number(id) {
    const value = byId(id).valueAsNumber;
    if (Number.isFinite(value)) return value;
    this.refuse(`${byId(id).getAttribute('aria-label')}: give a number`);
    return null;
  }

  hear() {
    byId('stop').addEventListener('click', () => this.stop());
    this.on('take', () => this.takeOrGive());
    this.on('home', () => this.command('home', {}));
    this.on('arm', () => this.command('arm', {}));
    this.on('acknowledge', () => this.command('acknowledge', { number: this.status.fault.number }));
    this.on('move', () => { const mm = this.number('target'); if (mm !== null) this.command('move', { target_m: mm / 1e3 }); });
    for (const [id, sign] of [['step-left', -1], ['step-right', 1]]) {
      this.on(id, () => {
        const distance = this.number('distance');
        if (distance !== null) this.command('jog', { distance_m: sign * distance * Number(byId('distance-unit').value) });
      });
    }
    this.on('identify', () => { const s = this.number('identify-duration'); if (s !== null) this.command('identify', { duration_s: s }); });
    this.on('record', () => this.command('record', { name: 'page' }));
    this.on('record-end', () => this.command('record', undefined, 'DELETE'));
    byId('jog-speed').addEventListener('input', () => this.show());
    for (const [id, direction] of [['jog-left', -1], ['jog-right', 1]]) {
      const button = byId(id);
      button.addEventListener('pointerdown', (event) => {
        if (event.button !== 0) return;
        if (button.hasPointerCapture(event.pointerId)) button.releasePointerCapture(event.pointerId); // touch has it by itself
        const why = whyNot(button.id, this.situation);
        if (why) this.refuse(`Jog: ${why}`); else this.holdJog(direction);
      });
      for (const kind of ['pointerup', 'pointercancel', 'pointerleave']) button.addEventListener(kind, () => this.letGo());
      button.addEventListener('contextmenu', (event) => event.preventDefault());
    }
    addEventListener('keydown', (event) => {
      if (event.key === 'Escape') { this.stop(); return; }
      if (event.target.closest('input, select') || event.repeat || event.ctrlKey || event.altKey || event.metaKey) return;
      if (event.key === 'ArrowLeft') this.holdJog(-1);
      if (event.key === 'ArrowRight') this.holdJog(1);
    });
    addEventListener('keyup', (event) => { if (event.key === 'ArrowLeft' || event.key === 'ArrowRight') this.letGo(); });
    addEventListener('blur', () => this.letGo());
    document.addEventListener('visibilitychange', () => { if (document.hidden) this.letGo(); });
    addEventListener('pagehide', () => this.letGo());
  }
}
