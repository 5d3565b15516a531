// Strips below the time line: the activity of each robot over time.

import { robotColour, SEEN, themed } from './colours.js';
import { KNOB } from './marks.js';
import { isAway, ENDED, LEFT, MOVING, SILENT } from './run_log.js';
import { prepared } from './shapes.js';
import { counted, element } from './text.js';
import { stateOf } from './words.js';

// Height of a strip [px]; lower and without names for more robots than this.
const STRIP = 12;
const NAMED_ROBOTS = 8;
// The log whose strips are shown.
let stripLog = null;

const KINDS = ['moving', 'waiting', 'unavailable', 'left'];

function kindOf(event) {
  if (event[5] === MOVING) return 0;
  if ([LEFT, SILENT, ENDED].includes(event[5])) return 3;
  return isAway(event) ? 2 : 1;
}

// Return the intervals of a robot (kind, begin, end) and the times of its measurements.
function historyOf(log, name) {
  const stretches = [];
  for (const event of log.slot('robot', name).events) {
    const last = stretches[stretches.length - 1];
    if (last && last[0] === kindOf(event)) continue;
    if (last) last[2] = event[0];
    stretches.push([kindOf(event), event[0], log.duration]);
  }
  const photos = log.slot('cuboid', name).events.filter((event) => event[8].length);
  return [stretches, log.isOfBuildings ? photos.map((event) => event[0]) : log.slot('seen', name).times];
}

function summary(stretches, measured) {
  const sums = [0, 0, 0, 0];
  for (const [kind, from, to] of stretches) sums[kind] += to - from;
  const total = sums.reduce((sum, item) => sum + item, 0) || 1;
  const parts = KINDS.map((kind, index) => [kind, Math.round((100 * sums[index]) / total)]).filter(([, share]) => share);
  return [...parts.map(([kind, share]) => `${kind} ${share} %`), counted(measured.length, 'measurement')].join(', ');
}

function drawStrip(canvas, log, names, name, height) {
  const width = canvas.clientWidth;
  const context = prepared(canvas, width, height);
  const x = (time) => KNOB + ((width - 2 * KNOB) * time) / (log.duration || 1);
  const [stretches, measured] = historyOf(log, name);
  for (const [kind, from, to] of stretches) {
    context.fillStyle = kind === 2 ? themed('--text') : robotColour(names, name);
    context.globalAlpha = kind === 1 ? 0.3 : 1;
    const wide = Math.max(x(to) - x(from), 1);
    if (kind < 3) context.fillRect(x(from), 1, wide, 0.55 * height);
    else {
      context.fillStyle = themed('--away');
      context.fillRect(x(from), 0.3 * height, wide, 1);
    }
  }
  context.globalAlpha = 1;
  context.fillStyle = SEEN;
  let last = -Infinity;
  for (const time of measured) {
    if (x(time) < last + 1) continue;
    last = x(time);
    context.fillRect(last - 0.75, 0.65 * height, 1.5, 0.3 * height);
  }
  canvas.setAttribute('aria-label', `${name}: ${summary(stretches, measured)}`);
}

// Show the strips and the time; return whether their height has changed.
export function showStrips(parent, log, time, onChoose) {
  const names = log.robots();
  const isNew = stripLog !== log || parent.dataset.names !== names.join();
  const height = names.length > NAMED_ROBOTS ? Math.max(3, Math.floor((NAMED_ROBOTS * STRIP) / names.length)) : STRIP;
  if (isNew) {
    stripLog = log;
    parent.dataset.names = names.join();
    parent.replaceChildren(...names.flatMap((name) => {
      const canvas = element('canvas', 'strip');
      canvas.setAttribute('role', 'img');
      canvas.style.height = `${height}px`;
      const at = (event) => (log.duration * (event.offsetX - KNOB)) / (canvas.clientWidth - 2 * KNOB);
      canvas.onpointermove = (event) => {
        canvas.title = `${name} at ${at(event).toFixed(1)} s: ${stateOf(log, name, at(event))}`;
      };
      canvas.onclick = (event) => onChoose(name, at(event));
      return [element('span', 'quiet', names.length > NAMED_ROBOTS ? '' : name), canvas];
    }), ...names.slice(0, 1).map(() => element('i', '')));
  }
  const strips = [...parent.querySelectorAll('canvas')];
  if (!strips.length) return isNew;
  const width = strips[0].clientWidth;
  const key = [width, window.devicePixelRatio, log.scene.name, log.size, document.documentElement.dataset.theme].join(' ');
  if (isNew || parent.dataset.key !== key) {
    parent.dataset.key = key;
    strips.forEach((canvas, index) => drawStrip(canvas, log, names, names[index], height));
  }
  const now = strips[0].offsetLeft + KNOB + ((width - 2 * KNOB) * time) / (log.duration || 1);
  parent.lastChild.style.left = `${now}px`;
  return isNew;
}
