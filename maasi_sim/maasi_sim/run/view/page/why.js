// The panel that explains the waypoint of a robot.

import { objectiveColours } from './colours.js';
import { icon } from './icons.js';
import { LEFT } from './run_log.js';
import { counted, element, number, pressable } from './text.js';

const COLUMNS = [
  ['x', 0, 'm'], ['y', 1, 'm'], ['z', 2, 'm'], ['J', 6, ''], ['C', 3, ''], ['T', 4, ''], ['E', 5, ''], ['K', 7, 'steps'], ['M', 8, ''],
];
const TITLES = {
  J: 'objective', C: 'control cost', T: 'target refinement', E: 'exploration', K: 'steps to reach it', M: 'measurements on the path',
};
let order = 6;

// Units of the terms: docs/planners.md.
function units(log) {
  const { objective, weights } = log.scene;
  const terms = objective === 'information' ? { T: 'nat', E: 'targets' } : { T: '', E: '' };
  return { C: '', ...terms, J: weights ? `per ${weights.per_distance ? 'metre' : 'step'}` : '' };
}

// Return the planner's sentence on its choice, or one derived from the numbers.
export function reasonOf(decision) {
  const { robot, event } = decision;
  const [, , chosen, , candidates, own] = robot;
  // The planner's sentence on all robots, if it gives none for this one.
  const given = own || (event[7].length > 1 ? '' : event[6]);
  // Round the numbers in the planner's sentence.
  if (given) return given.replace(/\d*\.\d+(e[-+]?\d+)?/g, (digits) => number(Number(digits)));
  if (chosen < 0) return 'stays: no candidate has a positive objective';
  const values = candidates.map((item) => item[6]).filter((value) => value !== null);
  const best = candidates[chosen] && candidates[chosen][6];
  if (values.every((value) => value === 0)) return `planner ${event[3]} chose this candidate without using J`;
  if (best >= Math.max(...values)) return `this candidate has the largest J of ${values.length}`;
  return `this candidate is part of the best joint choice for ${event[7].length} robots; for this robot alone another has a larger J`;
}

// Return the differences between the chosen candidate and the best other one.
export function gains(candidates, chosen) {
  let next = -1;
  candidates.forEach((item, index) => {
    if (index === chosen || item[6] === null) return;
    if (next < 0 || item[6] > candidates[next][6]) next = index;
  });
  if (next < 0 || chosen < 0 || !candidates[chosen]) return null;
  const [a, b] = [candidates[chosen], candidates[next]];
  return { next, C: a[3] - b[3], T: a[4] - b[4], E: a[5] - b[5], J: a[6] - b[6], K: a[7] - b[7] };
}

// Return what the planner expects from the chosen path and the next best one, as a sentence.
export function expectation(log, candidates, chosen) {
  const gain = gains(candidates, chosen);
  if (!gain || gain.J === 0) return '';
  const [own, other] = [candidates[chosen], candidates[gain.next]];
  const { objective, weights } = log.scene;
  if (objective !== 'information' || !weights) {
    return `has the ${gain.J > 0 ? 'larger' : 'smaller'} objective: J ${number(own[6])}, next best ${number(other[6])}`;
  }
  // J is per step: a longer path needs more.
  const seconds = (item) => `${number(item[7] * log.scene.step)} s`;
  const [here, there] = own[7] === other[7] ? ['', ''] : [` of ${seconds(own)}`, ` of ${seconds(other)}`];
  // The term with the larger part.
  if (weights.beta * own[5] >= weights.alpha * own[4]) {
    return `expects ${number(own[5])} new targets on this path${here}, and ${number(other[5])} on the next best${there}`;
  }
  if (!(other[4] > 0)) return `expects information on potential targets on this path${here}, and none on the next best${there}`;
  return `expects ${number(own[4] / other[4])} times as much information on potential targets on this path${here} as on the next best${there}`;
}

export function showWhy(parent, log, time, selected, marked, onMark) {
  const decision = selected && log.at('decision', selected, time);
  const state = selected && log.at('robot', selected, time);
  const hasLeft = state && state[5] === LEFT;
  const key = hasLeft ? `left ${selected}` : decision ? `${selected} ${decision.time} ${order} ${marked} ${log.scene.name}` : `none ${selected}`;
  if (parent.dataset.key === key) return;
  parent.dataset.key = key;
  // Keep an open fold open.
  const isOpen = Boolean(parent.querySelector('details[open]'));
  parent.replaceChildren();
  if (hasLeft) {
    parent.append(`${selected} has left.`);
    return;
  }
  if (!decision) {
    parent.append(selected ? `${selected} has not decided yet.` : 'Click a robot or a decision.');
    return;
  }
  if (decision.cuboid) showCuboid(parent, decision);
  else showCandidates(parent, log, decision, marked, onMark, isOpen);
}

function showCuboid(parent, { time, cuboid, name }) {
  const [, , , activity, how, target, heard, planned, shots] = cuboid;
  const place = target.map((value) => number(value)).join(', ');
  parent.append(
    element('p', 'expects', planned.length
      ? `${name} plans to visit ${planned.length === 1 ? 'cuboid' : 'cuboids'} ${planned.join(', ')} within its horizon.`
      : `${name} reaches no new cuboid within its horizon: it heads for the nearest unvisited one.`),
    element('p', 'quiet', `${name} at ${time.toFixed(1)} s: ${activity}; plan: ${how.replace('_', ' ')}`),
    element('p', '', `heads for (${place}) m`),
    element('p', '', `receives from ${heard.join(', ') || 'no robot'}`),
    element('p', '', shots.length ? `takes snapshots of ${shots.map((shot) => shot[0]).join(', ')}` : 'no snapshot now'),
  );
}

function showCandidates(parent, log, decision, marked, onMark, isOpen) {
  const [name, index, chosen, waypoint, candidates] = decision.robot;
  const unit = units(log);
  const place = waypoint.map((value) => number(value)).join(', ');
  const expects = expectation(log, candidates, chosen);
  if (expects) parent.append(element('p', 'expects', `${name} ${expects}.`));
  parent.append(
    element('p', 'reason', reasonOf(decision)),
    element('p', 'quiet', `${name}, decision ${index} at ${decision.time.toFixed(2)} s: ${chosen < 0 ? 'stays at' : 'goes to'} (${place}) m`),
  );
  // A single candidate is fully described above.
  if (candidates.length < 2) return;
  const fold = element('details', '');
  fold.open = isOpen;
  fold.append(element('summary', '', `All ${candidates.length} candidates in numbers`));
  parent.append(fold);
  const gain = gains(candidates, chosen);
  if (gain && gain.J !== 0) {
    const part = (term) => `${term} ${gain[term] >= 0 ? '+' : ''}${number(gain[term])} ${unit[term]}`.trim();
    const steps = `K ${gain.K >= 0 ? '+' : ''}${counted(gain.K, 'step')}`;
    fold.append(element('p', 'gain', `Difference to the next best (candidate ${gain.next}): ${['J', 'C', 'T', 'E'].map(part).join(', ')}, ${steps}`));
  }
  const { weights } = log.scene;
  if (weights) {
    const { control, alpha, beta } = weights;
    const terms = `-${number(control)} C + ${number(alpha)} T + ${number(beta)} E`;
    fold.append(element('p', 'formula quiet', `J = (${terms}) / ${weights.per_distance ? 'path length' : 'K'}`));
  }
  const table = element('table', '');
  const head = table.createTHead().insertRow();
  head.append(element('th', '', '#'));
  const columns = COLUMNS.filter(([title]) => title !== 'z' || candidates.some((item) => item[2] !== candidates[0][2]));
  for (const [title, column, columnUnit] of columns) {
    const cell = element('th', '', title);
    if (order === column) cell.prepend(icon('down'));
    cell.title = [TITLES[title], unit[title] || columnUnit].filter(Boolean).join(' ');
    pressable(cell, () => {
      order = column;
      onMark(marked);
    });
    head.append(cell);
  }
  const colours = objectiveColours(candidates);
  const rows = candidates.map((item, row) => [row, item]);
  rows.sort((a, b) => (b[1][order] ?? -Infinity) - (a[1][order] ?? -Infinity));
  const body = table.createTBody();
  for (const [row, item] of rows) {
    const line = body.insertRow();
    line.className = `${row === chosen ? 'chosen' : ''} ${row === marked ? 'marked' : ''}`;
    pressable(line, () => onMark(row));
    const first = element('td', '');
    const swatch = element('span', 'swatch');
    if (colours[row]) swatch.style.background = colours[row];
    first.append(swatch, String(row));
    line.append(first);
    for (const [, column] of columns) line.append(element('td', '', item[column] === null ? 'not allowed' : number(item[column], true)));
  }
  const rowsBox = element('div', 'rows');
  rowsBox.append(table);
  fold.append(rowsBox);
}
