// Numbers at a point of the map.

import { onEarth } from './earth.js';
import { counted, number } from './text.js';
import { stateOf } from './words.js';

function at(place, size) {
  return `at (${place.slice(0, size).map(number).join(', ')}) m`;
}

function tell(log, time, selected, hit) {
  const size = log.isSpatial ? 3 : 2;
  if (hit.robot) {
    const event = log.at('robot', hit.robot, time);
    const battery = event[4] >= 0 ? `, battery ${Math.round(100 * event[4])} %` : '';
    return `${hit.robot}: ${stateOf(log, hit.robot, time)}, ${at(event[3], 3)}${battery}`;
  }
  if (hit.found) {
    const [id, x, y, z, covariance, robot, when] = hit.found;
    const deviation = Math.sqrt(Math.max(covariance[0], covariance[3], size > 2 ? covariance[5] : 0));
    return `target ${id}: found by ${robot} at ${number(when)} s, ${at([x, y, z], size)}, deviation ${number(deviation)} m`;
  }
  if (hit.candidate !== undefined) {
    const decision = log.at('decision', selected, time);
    const item = decision && decision.robot && decision.robot[4][hit.candidate];
    if (!item) return '';
    const [, , , , refinement, exploration, objective, length, measurements] = item;
    const value = objective === null ? 'not allowed' : `J ${number(objective)}, T ${number(refinement)}, E ${number(exploration)}`;
    return `candidate ${hit.candidate} ${at(item, size)}: ${value}, ${counted(length, 'step')}, ${counted(measurements, 'measurement')} on the path`;
  }
  if (hit.report) {
    const [when, , , kind, , place, radius, weight] = hit.report;
    const words = kind === 'sighting' ? `sighting: ${number(weight)} expected within ${number(radius)} m` : `searched by others, probability of detection ${number(weight)}`;
    return `${words}, since ${number(when)} s, ${at(place, 2)}`;
  }
  if (hit.cluster) return `potential target: ${number(hit.cluster[3])} expected, ${at(hit.cluster, size)}`;
  if (hit.cuboid !== undefined) {
    const index = log.visits.events.findIndex((visit) => visit.cuboid === hit.cuboid);
    const isVisited = index >= 0 && log.visits.times[index] <= time;
    const by = isVisited ? `visited by ${log.visits.events[index].robot} at ${number(log.visits.times[index])} s` : 'to visit';
    const middle = log.scene.cuboids[hit.cuboid].map(([low, high]) => (low + high) / 2);
    return `cuboid ${hit.cuboid}: ${by}, ${at(middle, 3)}`;
  }
  if (hit.face) {
    const { object, name, done, total } = hit.face;
    return `${name} face of building ${object}: ${done} of ${total} parts photographed (${Math.round((100 * done) / total)} %)`;
  }
  return hit.truth ? `true target ${at(hit.truth, size)}` : '';
}

// Return the text for a point of the canvas.
export function tipAt(view, log, time, selected, x, y) {
  const hit = view.hit(x, y);
  const text = hit && tell(log, time, selected, hit);
  if (text) return text;
  const cell = view.unexplored.pick(view, x, y);
  // In 3D only cells have a position; in 2D the whole floor.
  if (!cell && (log.isSpatial || log.isOfBuildings)) return '';
  const { scene: { origin }, knowsExpected } = log;
  const place = cell ? cell.place : view.camera.ground(x, y, view.floor);
  const earth = origin ? `, latitude ${onEarth(place, origin).reverse().map((angle) => angle.toFixed(6)).join(', longitude ')}` : '';
  const where = `${at(place, 3)}${earth}`;
  if (!cell) return view.unexplored.cells ? `no target expected here, ${where}` : where;
  const belief = view.layers.belief ? `, ${view.belief.words(place)}` : '';
  const left = knowsExpected ? `${view.unexplored.amount(cell.left)} left` : `${Math.round((100 * cell.left) / view.unexplored.most)} % of the targets of unexplored ground left`;
  return `explored ${Math.round(100 - 100 * cell.share)} %, ${left}, ${where}${belief}`;
}

// Show a text next to a point of its parent; an empty one hides it.
export function showTip(tip, text, x, y) {
  tip.hidden = !text;
  if (!text) return;
  tip.textContent = text;
  const { clientWidth, clientHeight } = tip.parentElement;
  tip.style.left = `${Math.max(4, Math.min(x + 14, clientWidth - tip.offsetWidth - 4))}px`;
  tip.style.top = `${y + 18 + tip.offsetHeight > clientHeight ? Math.max(0, y - tip.offsetHeight - 12) : y + 18}px`;
}
