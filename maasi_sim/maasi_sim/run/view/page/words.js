// Texts of a run: its headline, what robots do, and map regions.

import { isAway, isStopped, ENDED, MOVING, UNAVAILABLE } from './run_log.js';
import { button, counted, element } from './text.js';

const STATES = ['no goal', 'moving', 'goal reached', 'goal cancelled', 'goal aborted', 'unavailable', 'left', 'silent', 'run ended'];
const MODES = ['waiting for start', 'searching', 'paused', 'sent home', 'stopped'];
// A position is near a potential target within this share of the environment's size, and unexplored
// above this share.
const NEAR = 0.08;
const UNEXPLORED = 0.5;
// Shortest time between two headlines [ms]: they are read aloud.
const HEADLINE_PERIOD = 1000;

// Return the mode of a robot in the search, as its planner reports it, or undefined.
export function modeOf(log, name, time) {
  const names = log.robots();
  for (const node of log.owners('mode')) {
    const path = node.split('/');
    const event = log.at('mode', node, time);
    if (!event || (names.some((other) => path.includes(other)) && !path.includes(name))) continue;
    const own = event[3].split(', ').find((part) => part.startsWith(`${name} `));
    if (own) return own.slice(name.length + 1);
    if (MODES.includes(event[3])) return event[3];
  }
  return undefined;
}

export function stateOf(log, name, time) {
  const event = log.at('robot', name, time);
  if (!event) return 'no state received';
  const [status, reason] = [event[5], event[6]];
  // Its reason may describe its last plan.
  if (status === UNAVAILABLE && hasEnded(log, time)) return 'run ended while unavailable';
  if (isStopped(event)) return 'stopped until released';
  const cuboid = log.at('cuboid', name, time);
  const mode = modeOf(log, name, time);
  let state = STATES[status] || 'unknown';
  if (isAway(event) || status === ENDED) return reason ? `${state}: ${reason}` : state;
  if (mode === 'stopped') state = 'search stopped until started';
  else if (mode && mode !== 'searching') state = status === MOVING ? `${mode}, moving` : mode;
  else if (cuboid) [, , , state] = cuboid;
  return reason && reason !== mode ? `${state}: ${reason}` : state;
}

// Return the map region of a position; north is +y.
export function regionOf(bounds, place) {
  const part = (axis, low, high) => {
    const share = (place[axis] - bounds[axis][0]) / (bounds[axis][1] - bounds[axis][0]);
    if (share < 1 / 3) return low;
    return share > 2 / 3 ? high : '';
  };
  const [across, up] = [part(0, 'west', 'east'), part(1, 'south', 'north')];
  if (across && up) return ['corner', ` in the ${up}-${across}`];
  return across || up ? ['part', ` in the ${across || up}`] : ['middle', ''];
}

function destination(log, time, place) {
  const [shape, where] = regionOf(log.bounds, place);
  if (log.unexplored(time, place) >= UNEXPLORED) return `the unexplored ${shape}${where}`;
  const reach = NEAR * Math.max(...log.bounds.map(([low, high]) => high - low));
  for (const space of log.owners('filter')) {
    const event = log.at('filter', space, time);
    const near = (item) => Math.hypot(...log.bounds.map((_, axis) => item[axis] - place[axis])) < reach;
    if (event && event[4].some((item) => item[3] >= 0.1 && near(item))) return `a potential target${where || ' in the middle'}`;
  }
  return `the ${shape}${where}`;
}

// Return what the moving robot that decided last is about to do.
function intention(log, time) {
  const { events } = log.decisions;
  const count = log.decisions.count(time);
  for (let index = count - 1; index >= Math.max(0, count - 40); index -= 1) {
    const { name, robot, cuboid } = events[index];
    const state = log.at('robot', name, time);
    if (!state || state[5] !== MOVING || log.at('decision', name, time) !== events[index]) continue;
    if (cuboid && cuboid[7].length) return `${name} goes to ${cuboid[7].length > 1 ? 'cuboids' : 'cuboid'} ${cuboid[7].join(', ')}${regionOf(log.bounds, cuboid[5])[1]}`;
    if (cuboid) return `${name} goes to ${destination(log, time, cuboid[5])}`;
    if (robot[2] >= 0) return `${name} goes to ${destination(log, time, robot[3])}`;
  }
  return '';
}

// Return the number of finds by a time, with the true and false ones if the truth is known.
export function harvest(log, time) {
  const score = log.at('score', '', time);
  const [count, wrong] = score ? [score[3], score[5]] : [log.found(time), 0];
  return (log.total ? `${count} of ${log.total}` : `${count}`) + (wrong ? ` (${wrong} false)` : '');
}

function harvested(log, time) {
  return `${harvest(log, time)} ${log.isOfBuildings ? 'cuboids visited' : 'found'}`;
}

function endWords(log, time) {
  const [ended = time, , , reason = '', text = ''] = log.at('end', '', time) || [];
  const score = log.at('score', '', time);
  const complete = reason === 'all_found' || (score ? score[4] === 0 : log.found(time) >= log.total);
  const after = `after ${Math.round(Math.min(ended, time))} s`;
  if (log.total && complete) {
    // A planner may continue after the last find.
    const { totals, visits } = log;
    const last = log.isOfBuildings ? visits.times[log.total - 1] : totals.times[totals.events.findIndex((count) => count >= log.total)];
    const when = reason === 'all_found' ? time : Math.min(last ?? time, time);
    return `All ${log.total} ${log.isOfBuildings ? 'cuboids visited' : 'found'} after ${Math.round(when)} s`;
  }
  const why = text.replace(/^\//, '') || reason.replaceAll('_', ' ');
  return `Ended: ${why ? `${why}; ` : ''}${harvested(log, time)} ${after}`;
}

export function hasEnded(log, time) {
  if (log.at('end', '', time)) return true;
  const events = log.robots().map((name) => log.at('robot', name, time)).filter(Boolean);
  // Recordings of earlier versions have no end event.
  return events.some((event) => event[5] === ENDED) && events.every((event) => event[5] === ENDED || isAway(event));
}

export function headline(log, time, connection = '') {
  if (hasEnded(log, time)) return endWords(log, time);
  const start = log.at('start', '', time);
  if (!log.owners('robot').length) {
    if (connection === 'ended') return 'Ended before the first step';
    if (!start) return connection ? 'Starting' : 'Nothing was recorded';
    return start[3] < start[4] ? `Starting: ${start[3]} of ${start[4]} nodes ready` : `Starting: all ${start[4]} nodes ready, connecting`;
  }
  const modes = log.robots().map((name) => modeOf(log, name, time));
  const words = { paused: 'Paused', 'sent home': 'Sent home', stopped: 'Stopped', 'waiting for start': 'Waiting for start' };
  const shared = modes.every((mode) => mode === modes[0]) && words[modes[0]];
  if (shared) return `${shared}: ${harvested(log, time)}`;
  const prefix = connection === 'connection lost' ? 'Connection lost' : 'Searching';
  return [`${prefix}: ${harvested(log, time)}`, intention(log, time)].filter(Boolean).join(', ');
}

// Show a headline for at least a second; return the time until it may change [ms].
export function showHeadline(parent, text, now) {
  if (parent.textContent === text) return 0;
  const wait = Number(parent.dataset.since || -HEADLINE_PERIOD) + HEADLINE_PERIOD - now;
  if (wait > 0) return wait;
  parent.dataset.since = now;
  parent.textContent = text;
  return 0;
}

// Show how a run ended, its replay file, and the command to repeat it.
export function showCard(parent, log, time, onClose) {
  const { command, replay } = log.scene;
  const measured = log.measurements(time);
  const title = endWords(log, time) + (measured ? `, with ${counted(measured, 'measurement')}` : '');
  if (parent.dataset.key === title) return;
  parent.dataset.key = title;
  const close = button('Close', onClose);
  const rows = [['Replay', replay], ['Repeat it', command]].filter(([, text]) => text);
  parent.replaceChildren(
    element('strong', '', title),
    ...rows.map(([name, text]) => {
      const row = element('span', '', `${name}: `);
      row.append(element('code', '', text));
      return row;
    }),
    close,
  );
}
