// The panels next to the map: numbers, robots, log.

import { robotColour, themed } from './colours.js';
import { icon } from './icons.js';
import { isAway } from './run_log.js';
import { element, number, pressable } from './text.js';
import { harvest, hasEnded, stateOf } from './words.js';

const SIGNS = ['found', 'decision', 'team', 'warning', 'fault'];
// Shown lines of the log.
const MOST_LINES = 60;

// Show the main numbers first; scores and counts are in a fold.
export function showNumbers(parent, fold, log, time, unexplored) {
  const first = [[log.isOfBuildings ? 'visited' : 'found', harvest(log, time), 'found_count']];
  const { searched } = unexplored;
  if (searched !== undefined) first.push(['explored area', `${Math.round(100 * searched)} % of ${area(log.scene.ground || unexplored.ground)}`]);
  first.push(['time', `${Math.round(time)} s`]);
  const charges = log.robots().map((name) => [name, log.at('robot', name, time)]).filter(([, event]) => event && event[4] >= 0);
  if (charges.length) {
    const [name, event] = charges.reduce((least, item) => (item[1][4] < least[1][4] ? item : least));
    first.push(['lowest battery', `${Math.round(100 * event[4])} % (${name})`]);
  }
  showRows(parent, first);
  showRows(fold, log.isOfBuildings ? [['snapshots', shots(log, time)]] : counts(log, time));
}

// Return an area with a unit that suits it.
function area(ground) {
  const [unit, name] = [[1, 'm²', 1e4], [1e4, 'ha', 1e6], [1e6, 'km²', Infinity]].find(([, , limit]) => ground < limit);
  return `${number(ground / unit)} ${name}`;
}

function counts(log, time) {
  const score = log.at('score', '', time);
  const explored = log.explored.at(time);
  const rows = log.knowsExpected ? [['expected left', number(log.left.at(time))]] : [];
  rows.push(
    ['potential', number(log.potential.at(time))],
    ['measurements', log.measurements(time)],
    ['decisions', log.decisions.count(time)],
    ['explored', explored === undefined ? '-' : `${Math.round(100 * explored)} %`],
  );
  if (!score) return rows;
  const [, , , right, missed, wrong, rmse, gospa] = score;
  return [
    ...rows,
    ['true, false', `${right}, ${wrong}`],
    [hasEnded(log, time) ? 'missed' : 'not found yet', missed],
    ['RMSE', rmse === null ? '-' : `${number(rmse)} m`],
    ['GOSPA', `${number(gospa)} m`],
  ];
}

function showRows(parent, rows) {
  parent.replaceChildren(
    ...rows.flatMap(([title, value, id]) => {
      const cell = element('dd', '', String(value));
      if (id) cell.id = id;
      return [element('dt', '', title), cell];
    }),
  );
}

function shots(log, time) {
  let sum = 0;
  for (const name of log.owners('cuboid')) {
    const slot = log.slot('cuboid', name);
    for (let index = slot.count(time) - 1; index >= 0; index -= 1) sum += slot.events[index][8].length;
  }
  return sum;
}

export function showRobots(body, log, time, selected, onSelect) {
  const names = log.robots();
  const shown = names.map((name) => {
    const event = log.at('robot', name, time);
    return [name, stateOf(log, name, time), event && event[4]];
  });
  const key = JSON.stringify([shown, selected, document.documentElement.dataset.theme]);
  if (body.dataset.key === key) return;
  body.dataset.key = key;
  // New rows lose the keyboard focus, and a click that has begun.
  if ([...body.rows].map((row) => row.dataset.robot).join() !== names.join()) {
    body.replaceChildren(...names.map((name) => robotRow(log, name, onSelect)));
  }
  shown.forEach(([name, state], index) => {
    const [row, event] = [body.rows[index], log.at('robot', name, time)];
    const [first, text, battery] = row.cells;
    const known = Boolean(event && event[4] >= 0);
    row.classList.toggle('selected', name === selected);
    first.firstChild.style.background = event && isAway(event) ? themed('--away') : robotColour(names, name);
    text.textContent = state;
    battery.firstChild.hidden = !known;
    if (known) battery.firstChild.firstChild.style.width = `${Math.round(100 * event[4])}%`;
    battery.lastChild.textContent = known ? `${Math.round(100 * event[4])} %` : 'unknown';
  });
}

function robotRow(log, name, onSelect) {
  const [row, first, battery, bar] = [element('tr', ''), element('td', ''), element('td', ''), element('span', 'bar')];
  row.dataset.robot = name;
  pressable(row, () => onSelect(name));
  first.append(element('span', 'swatch'), name);
  first.title = (log.scene.robots[name] || {}).description || '';
  bar.append(element('i', ''));
  battery.append(bar, document.createTextNode(''));
  row.append(first, element('td', 'text', ''), battery);
  return row;
}

export function showLog(list, log, time, onChoose) {
  const count = log.lines.count(time);
  const key = `${log.scene.name} ${count}`;
  if (list.dataset.key === key) return;
  list.dataset.key = key;
  const lines = log.lines.events.slice(Math.max(0, count - MOST_LINES), count).reverse();
  list.replaceChildren(
    ...lines.map((event) => {
      const [when, , , level, source, text] = event;
      const line = element('li', level);
      line.dataset.level = level;
      pressable(line, () => onChoose(event));
      const sign = element('b', '');
      if (SIGNS.includes(level)) sign.append(icon(level));
      line.append(element('time', '', `${when.toFixed(1)} s`), sign, element('span', '', `${source}: ${text}`));
      return line;
    }),
  );
}
