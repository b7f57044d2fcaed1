// What a state means, and why a button can't be pressed now: pure. A situation is
// {status, held, mayOperate, jogging}: the newest status or null, whether this page has the lease, what it may do (null:
// not known yet).

const POWERED = ['arming', 'armed', 'moving', 'identifying', 'stopping'];
const UNDER_WAY = {
  off: 'the stage is not connected', idle: 'the drives have no power; arm first', arming: 'wait until it is armed',
  armed: 'it is armed already', moving: 'wait for the motion\'s end, or stop it',
  identifying: 'wait for the sweep\'s end, or stop it', stopping: 'wait until it stands', fault: 'acknowledge the fault first',
};

export const isPowered = (state) => POWERED.includes(state);

// One sentence on what the stage does, and what an operator would do next.
export function meaning({ status, held }) {
  if (!status) return '';
  const lease = held ? '' : status.lease ? `${status.lease.holder} operates. ` : 'Take the lease, then ';
  const then = (text) => (held ? `${text[0].toUpperCase()}${text.slice(1)}.` : status.lease ? lease.trim() : `${lease}${text}.`);
  switch (status.state) {
    case 'off': return `Not connected. Waits for ${status.waiting_for || 'an acknowledgement'}.`;
    case 'idle': return status.homed ? `No power. ${then('arm')}` : `No power, not homed. ${then('home')}`;
    case 'arming': return 'The drives are being enabled.';
    case 'armed': return status.homed ? 'Power is on, it holds. Move, jog or identify; STOP takes the power away.' : `Power is on, not homed. ${then('home')}`;
    case 'moving': return 'In motion. STOP brings it to rest.';
    case 'identifying': return 'The micro sweeps over both edges. STOP brings it to rest.';
    case 'stopping': return 'Comes to rest, then without power.';
    case 'fault': return `It stopped by itself. ${then('clear the cause and acknowledge')}`;
    default: return '';
  }
}

const needsLease = ({ held }) => (held ? '' : 'take the lease first');

function needsArmed(situation) {
  const { status, jogging } = situation;
  if (needsLease(situation)) return needsLease(situation);
  if (!status.homed) return status.state === 'idle' || status.state === 'armed' ? 'home first' : UNDER_WAY[status.state];
  return status.state === 'armed' || jogging ? '' : UNDER_WAY[status.state];
}

const WHY_NOT = {
  take({ status, held }) {
    if (held) return '';
    if (status.lease) return `${status.lease.holder} operates, and one does at a time; free when given back, or ${Math.ceil(status.lease.duration_s)} s after its holder is gone`;
    return isPowered(status.state) ? 'the stage still has power; wait until it stands' : '';
  },
  home: (situation) => needsLease(situation) || (['idle', 'armed'].includes(situation.status.state) ? '' : UNDER_WAY[situation.status.state]),
  arm(situation) {
    const { status } = situation;
    if (needsLease(situation)) return needsLease(situation);
    if (status.state !== 'idle') return UNDER_WAY[status.state];
    return status.homed ? '' : 'home first';
  },
  move: needsArmed,
  identify: needsArmed,
  acknowledge: (situation) => (situation.status.state === 'fault' ? needsLease(situation) : 'there is no fault'),
  record({ status }) {
    if (status.state === 'off') return UNDER_WAY.off;
    return status.recording?.run ? `${status.recording.run} is under way and has every cycle` : '';
  },
  'record-end': ({ status }) => (status.recording?.trigger === 'request' ? '' : 'no run was begun by hand'),
};
for (const id of ['jog-left', 'jog-right', 'step-left', 'step-right']) WHY_NOT[id] = needsArmed;

export const BUTTONS = Object.keys(WHY_NOT);

// Why the button with this id can't be used now; '' where it can.
export function whyNot(id, situation) {
  if (situation.mayOperate === null) return 'the page\'s process has not said yet who operates here';
  if (!situation.mayOperate) return 'this page may only watch; open the link to operate in this browser';
  if (!situation.status) return 'the service doesn\'t answer';
  return WHY_NOT[id](situation);
}
