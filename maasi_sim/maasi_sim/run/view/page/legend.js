// The legend of the map.

import { FOUND, OPEN, POTENTIAL, SEEN, SIGHTED, VISITED, robotColour, scaleColour } from './colours.js';
import { faceColour, PHOTOGRAPHED } from './buildings.js';
import { icon } from './icons.js';
import { placedReports } from './statements.js';
import { element } from './text.js';

const HEAT = 'linear-gradient(90deg, rgba(var(--heat-low), .25), rgba(var(--heat-high), .9))';

// Return the entries: class of the mark, its colour, text, and icon.
function entries(log, time, selected, { layers, unexplored }) {
  const isEmpty = !(log.potential.at(time) >= 0.005);
  const mostLeft = log.knowsExpected && unexplored.most ? `0 to ${unexplored.amount(unexplored.most)} (shade grows with the square root)` : 'from least to most likely';
  const robots = Object.values(log.scene.robots);
  const hasZone = (kind) => log.zones(time).some((zone) => zone.kind === kind);
  const reported = new Set(placedReports(log, time).map((event) => event[3]));
  const hasTour = log.robots().some((name) => ((log.at('decision', name, time) || {}).robot || [])[6]?.length);
  const cividis = `linear-gradient(90deg, ${[0, 0.25, 0.5, 0.75, 1].map(scaleColour).join(', ')})`;
  const faceGradient = `linear-gradient(90deg, ${faceColour(0)}, ${faceColour(1)})`;
  const of = (...list) => list.filter(Boolean);
  const paths = of(
    ['icon', '', 'robot (each has its colour)', 'rover'],
    robots.some((robot) => robot.flies) && ['icon', '', 'multirotor', 'multirotor'],
    ['icon', 'var(--away)', 'robot that left or is unavailable', 'rover'],
    ['line', '', 'path so far'],
  );
  if (log.isOfBuildings) {
    return of(
      ...paths,
      ['box', OPEN, 'cuboid to visit'],
      ['box', 'var(--text)', 'planned cuboid, in the colour of its robot'],
      ['box', VISITED, 'cuboid visited'],
      ['area', 'rgba(140, 140, 160, .75)', 'building'],
      log.scene.cells && ['area', faceGradient, 'face of a building: share photographed, 0 to 100 %'],
      log.scene.cells && ['area', PHOTOGRAPHED, 'photographed part'],
      (log.scene.blocks || []).length && ['area', 'rgb(110, 100, 85)', 'obstacle'],
      ['dot', '', 'radio link, or the point a robot heads for'],
    );
  }
  return of(
    layers.unseen && ['area', 'linear-gradient(90deg, rgba(var(--unseen), .53), transparent)', 'explored: probability that a target there would have been detected, 0 to 100 %'],
    layers.left && ['area', 'linear-gradient(90deg, rgba(var(--left), .05), rgba(var(--left), .65))', `probable undetected targets: ${mostLeft}`],
    layers.belief && ['area', HEAT, `potential targets per area, from few to many${isEmpty ? ' (none now)' : ''}`],
    ...paths,
    ['dash', '', 'planned path'],
    ['box', '', 'waypoint'],
    hasTour && ['thin', '', 'rest of the tour'],
    robots.some((robot) => robot.view) && ['dotbox', '', 'field of view'],
    ['ring', FOUND, 'found (3 sigma)'],
    ['ring', POTENTIAL, 'potential target, with its expected number'],
    ['icon', SEEN, 'detection', 'cross'],
    ['icon', '', 'true target', 'cross'],
    (log.scene.obstacles || []).length && ['area', 'var(--quiet)', 'obstacle'],
    (log.scene.obstacles || []).length && ['dash', 'var(--text)', 'clearance around obstacles'],
    hasZone('area') && ['line', 'var(--text)', 'border of the area'],
    hasZone('keep_out') && ['area', 'repeating-linear-gradient(45deg, #8f9900 0 2px, rgba(143, 153, 0, .25) 2px 5px)', 'keep-out zone'],
    reported.has('sighting') && ['dot', SIGHTED, 'sighting: contains the target with 86 %'],
    reported.has('searched') && ['dot', VISITED, 'ground searched by others'],
    robots.some((robot) => robot.fence) && ['dash', '', 'geofence (dash and dot)'],
    selected && ['area', cividis, 'candidate of the selected robot: objective J from low to high'],
    selected && ['ring', 'var(--text)', 'candidate that is not allowed'],
  );
}

// Return the entries of the strips below the time line.
function stripEntries(log) {
  const names = log.robots();
  const colour = robotColour(names, names[0]);
  if (!names.length) return [];
  return [
    ['break'],
    ['text', '', 'Strips, one per robot:', ''],
    ['area', colour, 'moving'],
    ['area', `${colour}4d`, 'waiting'],
    ['area', 'var(--text)', 'unavailable'],
    ['line', 'var(--away)', 'left, silent or ended'],
    ['icon', SEEN, log.isOfBuildings ? 'snapshot' : 'measurement', 'tick'],
  ];
}

export function showLegend(parent, log, time, selected, map) {
  const shown = [...entries(log, time, selected, map), ...stripEntries(log)];
  if (log.scene.thinned) shown.push(['text', '', `reduced to one state per ${log.scene.thinned} s`]);
  const key = JSON.stringify(shown);
  if (parent.dataset.key === key) return;
  parent.dataset.key = key;
  parent.replaceChildren(
    ...shown.map(([kind, colour, text, sign]) => {
      if (kind === 'break') return element('br', '');
      const entry = element('span', '');
      const mark = element('i', kind);
      if (sign) mark.append(icon(sign));
      mark.setAttribute('aria-hidden', 'true');
      if (kind === 'area') mark.style.background = colour;
      else if (colour) mark.style.color = colour;
      entry.append(mark, text);
      return entry;
    }),
  );
}
