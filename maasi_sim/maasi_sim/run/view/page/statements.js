// Statements of persons on the map: sightings, and ground that others have searched.

import { SIGHTED, VISITED } from './colours.js';
import { circle, cross, path, trace } from './shapes.js';

// Return the statements that a filter counts at a time.
export function reportsAt(log, space, time) {
  const slot = log.slot('report', space);
  const events = slot.events.slice(0, slot.count(time));
  return events.slice(events.findLastIndex((event) => event[3] === 'cleared') + 1);
}

// Return the statements on the map: those of several filters are the same.
export function placedReports(log, time) {
  const seen = new Set();
  return log.owners('report').flatMap((space) => reportsAt(log, space, time)).filter((event) => {
    const key = JSON.stringify(event.slice(3));
    if (!['sighting', 'searched'].includes(event[3]) || seen.has(key)) return false;
    seen.add(key);
    return true;
  });
}

export function drawReports({ context, camera, floor, targets }, log, time) {
  context.lineWidth = 2;
  for (const event of placedReports(log, time)) {
    const [, , , kind, , [x, y], radius, , zones] = event;
    context.strokeStyle = kind === 'sighting' ? SIGHTED : VISITED;
    context.setLineDash([2, 4]);
    if (kind === 'sighting') path(context, camera, circle([x, y, floor], radius), true);
    else {
      context.beginPath();
      for (const { rings } of zones) for (const ring of rings) trace(context, camera, ring.map(([a, b]) => [a, b, floor]));
    }
    context.stroke();
    context.setLineDash([]);
    const [px, py] = camera.project([x, y, floor]);
    cross(context, px, py, 4);
    targets.push({ x: px, y: py, report: event });
  }
  context.lineWidth = 1;
}
