// Draws a search of buildings: objects, cuboids visited and to visit, and radio links.

import { OPEN, VISITED, robotColour, themed } from './colours.js';
import { isAway, MOVING } from './run_log.js';
import { box, path, side } from './shapes.js';

const FACES = ['west', 'east', 'south', 'north', 'bottom', 'top'];
export const PHOTOGRAPHED = '#2f8fd0';

// Return the colour of a face by its photographed share.
export function faceColour(share) {
  return `rgba(${140 - 93 * share}, 140, ${160 + 48 * share}, .75)`;
}

export function drawBuildings(view, log, time) {
  const { context, camera } = view;
  const visited = new Set();
  const count = log.visits.count(time);
  for (let index = 0; index < count; index += 1) visited.add(log.visits.events[index].cuboid);
  const planned = new Map();
  for (const name of log.owners('cuboid')) {
    const event = log.at('cuboid', name, time);
    const here = log.at('robot', name, time);
    // Only moving robots execute their plan.
    if (event && here && here[5] === MOVING) for (const cuboid of event[7]) planned.set(cuboid, name);
  }
  const boxes = [
    ...(log.scene.objects || []).map((sides, object) => ({ sides, object, fill: 'rgba(140, 140, 160, .75)', stroke: themed('--quiet') })),
    ...(log.scene.blocks || []).map((sides) => ({ sides, fill: 'rgba(110, 100, 85, .85)', stroke: themed('--text') })),
    ...(log.scene.cuboids || []).map((sides, cuboid) => ({ sides, cuboid, ...look(cuboid) })),
  ];
  function look(cuboid) {
    if (visited.has(cuboid)) return { fill: 'rgba(86, 180, 233, .16)', stroke: VISITED };
    if (planned.has(cuboid)) {
      return { fill: 'rgba(213, 94, 0, .4)', stroke: robotColour(view.names, planned.get(cuboid)), wide: true };
    }
    return { fill: 'rgba(213, 94, 0, .28)', stroke: OPEN };
  }
  const middle = ([x, y, z]) => camera.project([(x[0] + x[1]) / 2, (y[0] + y[1]) / 2, (z[0] + z[1]) / 2]);
  for (const item of boxes) {
    const [x, y, depth] = middle(item.sides);
    item.depth = depth;
    if (item.cuboid !== undefined) view.targets.push({ x, y, cuboid: item.cuboid });
  }
  boxes.sort((a, b) => b.depth - a.depth);
  for (const item of boxes) {
    context.lineWidth = item.wide ? 2.5 : 1;
    box(context, camera, item.sides, item.fill, item.stroke);
    if (item.object !== undefined) drawFaces(view, log, visited, item);
  }
  context.lineWidth = 1;
  drawLinks(view, log, time);
}

// The faces of an object by photographed share, and photographed parts; from above walls are lines.
function drawFaces(view, log, visited, { object, sides }) {
  const { context, camera } = view;
  const cells = (log.scene.cells || []).map(([owner, number, part], cuboid) => ({ owner, number, part, cuboid }));
  FACES.forEach((name, number) => {
    const own = cells.filter((cell) => cell.owner === object && cell.number === number);
    const done = own.filter((cell) => visited.has(cell.cuboid));
    if (!own.length) return;
    const axis = number >> 1;
    const place = sides.map(([low, high], other) => (other === axis ? sides[axis][number % 2] : (low + high) / 2));
    const isWall = !camera.spatial && axis < 2;
    const colour = faceColour(done.length / own.length);
    if (isWall) {
      const along = 1 - axis;
      path(context, camera, sides[along].map((value) => place.map((other, index) => (index === along ? value : other))));
      context.lineWidth = 6;
      context.strokeStyle = colour;
      context.stroke();
      context.lineWidth = 1;
    } else {
      if (!camera.spatial && name === 'bottom') return;
      if (!side(context, camera, sides, number, colour, themed('--quiet'))) return;
      for (const cell of done) side(context, camera, cell.part, number, PHOTOGRAPHED, themed('--floor'));
    }
    const [x, y] = camera.project(place);
    view.targets.push({ x, y, face: { object, name, done: done.length, total: own.length } });
  });
}

// Lines between robots that receive from each other.
function drawLinks(view, log, time) {
  const { context, camera } = view;
  context.strokeStyle = themed('--text');
  context.globalAlpha = 0.5;
  context.setLineDash([1, 4]);
  context.lineWidth = 1.5;
  for (const name of log.owners('cuboid')) {
    const event = log.at('cuboid', name, time);
    const here = log.at('robot', name, time);
    if (!event || !here || isAway(here)) continue;
    for (const other of event[6]) {
      const there = log.at('robot', other, time);
      const answers = other < name && (log.at('cuboid', other, time) || [])[6];
      if (!there || isAway(there) || (answers && answers.includes(name))) continue;
      path(context, camera, [here[3], there[3]]);
      context.stroke();
    }
    if (here[5] !== MOVING) continue;
    context.globalAlpha = 0.9;
    context.strokeStyle = robotColour(view.names, name);
    path(context, camera, [here[3], event[5]]);
    context.stroke();
    context.globalAlpha = 0.5;
    context.strokeStyle = themed('--text');
  }
  context.setLineDash([]);
  context.globalAlpha = 1;
  context.lineWidth = 1;
}
