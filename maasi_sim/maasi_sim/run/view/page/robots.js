// Draws robots: positions, fields of view, past and planned paths.

import { robotColour, themed } from './colours.js';
import { isAway, LEFT, MOVING } from './run_log.js';
import { dropLine, ellipse, matrix, path } from './shapes.js';

// Half length of a robot [px], and outlines for a heading along x.
const SIZE = 9;
const ROVER = new Path2D('M1.4 0 L-0.9 0.8 L-0.5 0 L-0.9 -0.8 Z');
const MULTIROTOR = new Path2D('M1.5 0 L0.9 0.35 L-0.5 0.35 L-0.5 -0.35 L0.9 -0.35 Z');
for (const [ahead, side] of [[0.8, 0.8], [0.8, -0.8], [-0.8, 0.8], [-0.8, -0.8]]) {
  MULTIROTOR.moveTo(ahead + 0.55, side);
  MULTIROTOR.arc(ahead, side, 0.55, 0, 2 * Math.PI);
}
// Drawn points of a path.
const MOST_POINTS = 600;

// Return a planned path from its robot's current position.
function rest(way, here) {
  let nearest = 0;
  const distance = (place) => Math.hypot(...[0, 1, 2].map((axis) => place[axis] - here[axis]));
  way.forEach((place, index) => {
    if (distance(place) < distance(way[nearest])) nearest = index;
  });
  return [here, ...way.slice(nearest + 1)];
}

export function drawWays(view, log, time) {
  const { context, camera } = view;
  for (const name of view.names) {
    const slot = log.slot('robot', name);
    const count = slot.count(time);
    if (!count || slot.events[count - 1][5] === LEFT) continue;
    context.strokeStyle = robotColour(view.names, name);
    const stride = Math.ceil(count / MOST_POINTS);
    const points = [];
    for (let index = 0; index < count; index += stride) points.push(slot.events[index][3]);
    const here = log.pose(name, time);
    points.push(here);
    context.lineWidth = 1.6;
    context.globalAlpha = 0.85;
    path(context, camera, points);
    context.stroke();
    context.globalAlpha = 1;
    if (slot.events[count - 1][5] === MOVING) drawPlan(view, log, time, name, here);
  }
  context.lineWidth = 1;
}

// The planned path (dashed), its waypoint (box), and the rest of its tour (thin).
function drawPlan(view, log, time, name, here) {
  const { context, camera } = view;
  const way = log.at('way', name, time);
  const decision = log.at('decision', name, time);
  const waypoint = decision && decision.robot && decision.robot[2] >= 0 ? decision.robot[3] : null;
  context.lineWidth = 2;
  context.setLineDash([6, 5]);
  if (way || waypoint) {
    path(context, camera, way ? rest(way[3], here) : [here, waypoint]);
    context.stroke();
  }
  context.setLineDash([]);
  if (waypoint) {
    context.lineWidth = 1;
    context.setLineDash([3, 4]);
    path(context, camera, [waypoint, ...(decision.robot[6] || [])]);
    context.stroke();
    context.setLineDash([]);
    context.lineWidth = 2;
    const [x, y] = camera.project(waypoint);
    context.strokeRect(x - 5, y - 5, 10, 10);
    dropLine(context, camera, waypoint, view.floor);
  }
}

export function drawRobot(view, log, time, name, selected) {
  const event = log.at('robot', name, time);
  if (!event) return;
  const { context, camera } = view;
  const [x, y, z, yaw] = log.pose(name, time);
  const robot = log.scene.robots[name] || {};
  const isPale = isAway(event);
  const colour = isPale ? themed('--away') : robotColour(view.names, name);
  context.strokeStyle = colour;
  context.fillStyle = colour;
  if (view.layers.view && robot.view && !isPale) drawFieldOfView(view, robot.view, [x, y, z, yaw], log.isSpatial);
  if (log.isSpatial || z > 0) dropLine(context, camera, [x, y, z], view.floor);
  const [px, py] = camera.project([x, y, z]);
  // Constant size on the screen, rotated with the view.
  const [ahead, side] = [[Math.cos(yaw), Math.sin(yaw)], [-Math.sin(yaw), Math.cos(yaw)]].map(([dx, dy]) => {
    const step = 1 / camera.scale;
    const [ex, ey] = camera.project([x + step * dx, y + step * dy, z]);
    return [ex - px, ey - py];
  });
  context.save();
  context.transform(SIZE * ahead[0], SIZE * ahead[1], SIZE * side[0], SIZE * side[1], px, py);
  const outline = robot.flies ? MULTIROTOR : ROVER;
  context.fill(outline);
  context.strokeStyle = selected ? themed('--text') : themed('--back');
  context.lineWidth = (selected ? 2.5 : 1) / SIZE;
  context.stroke(outline);
  context.restore();
  const text = event[5] === LEFT ? `${name} (left)` : name;
  view.labels.add(text, px, py, { font: '600 12px system-ui, sans-serif', away: 12, needed: true });
  view.targets.push({ x: px, y: py, robot: name });
}

function drawFieldOfView(view, seen, [x, y, z, yaw], isSpatial) {
  const { context, camera } = view;
  context.globalAlpha = 0.9;
  context.setLineDash([2, 2]);
  if (seen.kind === 'box') {
    const [cos, sin] = seen.turns ? [Math.cos(yaw), Math.sin(yaw)] : [1, 0];
    const heights = isSpatial && seen.lower.length === 3 ? [z + seen.lower[2], z + seen.upper[2]] : [0];
    for (const height of heights) {
      const corners = [[seen.lower[0], seen.lower[1]], [seen.upper[0], seen.lower[1]], [seen.upper[0], seen.upper[1]], [seen.lower[0], seen.upper[1]]];
      path(context, camera, corners.map(([ahead, left]) => [x + ahead * cos - left * sin, y + ahead * sin + left * cos, height]), true);
      context.stroke();
      context.save();
      context.globalAlpha = 0.12;
      context.fill();
      context.restore();
    }
  } else {
    const [a, b, c = 0] = seen.size;
    ellipse(context, camera, [x, y, z], matrix([a * a, 0, 0, b * b, 0, c * c]), 1);
    context.stroke();
  }
  context.setLineDash([]);
  context.globalAlpha = 1;
}
