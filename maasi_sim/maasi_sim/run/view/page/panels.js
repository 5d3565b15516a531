// The panels beside the map: numbers, robots, log.

import { robotColour, themed } from './colours.js';
import { isAway } from './run_log.js';
import { element, number, pressable } from './text.js';
import { stateOf } from './words.js';

const SIGNS = { found: '●', decision: '→', team: '◇', warning: '!', fault: '✖' };
// Lines of the log that are shown.
const MOST_LINES = 60;

export function showNumbers(parent, log, time) {
  const score = log.at('score', '', time);
  const explored = log.explored.at(time);
  const total = log.total;
  const rows = [
    [log.isOfBuildings ? 'visited' : 'found', `${log.found(time)}${total ? ` of ${total}` : ''}`, 'found_count'],
  ];
  if (log.isOfBuildings) rows.push(['snapshots', shots(log, time)]);
  else {
    if (log.knowsExpected) rows.push(['expected left', number(log.left.at(time))]);
    rows.push(['potential', number(log.potential.at(time))]);
    rows.push(['measurements', log.measurements(time)]);
    rows.push(['explored', explored === undefined ? '-' : `${Math.round(100 * explored)} %`]);
    rows.push(['decisions', log.decisions.count(time)]);
  }
  if (score) {
    rows.push(['true, false', `${score[3]}, ${score[5]}`]);
    rows.push(['missed', score[4]]);
    rows.push(['RMSE', score[6] === null ? '-' : `${number(score[6])} m`]);
    rows.push(['GOSPA', `${number(score[7])} m`]);
  }
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
  // Rows that are made again lose the focus of the keyboard.
  const key = JSON.stringify([shown, selected, document.documentElement.dataset.theme]);
  if (body.dataset.key === key) return;
  body.dataset.key = key;
  body.replaceChildren(
    ...shown.map(([name, state]) => {
      const event = log.at('robot', name, time);
      const row = element('tr', name === selected ? 'selected' : '');
      row.dataset.robot = name;
      pressable(row, () => onSelect(name));
      const first = element('td', '');
      const swatch = element('span', 'swatch');
      swatch.style.background = event && isAway(event) ? themed('--away') : robotColour(names, name);
      first.append(swatch, name);
      first.title = (log.scene.robots[name] || {}).description || '';
      const battery = element('td', '');
      if (event && event[4] >= 0) {
        const bar = element('span', 'bar');
        const level = element('i', '');
        level.style.width = `${Math.round(100 * event[4])}%`;
        bar.append(level);
        battery.append(bar, `${Math.round(100 * event[4])} %`);
      } else battery.append('unknown');
      row.append(first, element('td', 'text', state), battery);
      return row;
    }),
  );
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
      line.append(element('time', '', `${when.toFixed(1)} s`), element('b', '', SIGNS[level] || ''), element('span', '', `${source}: ${text}`));
      return line;
    }),
  );
}
