// What is unexplored: the map as it was last published, less what robots have seen since, as the
// planner reckons it: each look at a place multiplies its e by 1 - pi. So the dark goes as the field
// of view moves, not once a second.

import { themed } from './colours.js';
import { FloorGrid } from './floor_grid.js';
import { isAway } from './run_log.js';

// Where the chance to see something ends, in sizes of a sensor.
const SIGHT = { exponential: 7, gaussian: 3 };
// Largest opacity of a cell, up to 255; cells below this e are not drawn in space.
const DARKEST = 135;
const FAINTEST = 0.06;
// Most cells that are drawn in space.
const MOST_CELLS = 3000;

// Return from where robots looked since a time, and where each is now: sensor, and place with yaw.
function looks(log, time, space, since) {
  // The map of a robot that plans for itself has only its own.
  const own = space.split('/').pop();
  const list = [];
  for (const name of log.robots()) {
    const { view } = log.scene.robots[name] || {};
    const state = log.at('robot', name, time);
    if (!view || !state || isAway(state) || (log.scene.robots[own] && name !== own)) continue;
    list.push({ view, place: log.pose(name, time) });
    const { times, events } = log.slot('seen', name);
    for (let index = log.slot('seen', name).count(time) - 1; index >= 0 && times[index] > since; index -= 1) {
      const [, , , yaw] = log.pose(name, times[index]) || [0, 0, 0, 0];
      list.push({ view, place: [...events[index][3], yaw] });
    }
  }
  return list;
}

// Return the chance to see a target at an offset; the edge of a box is as soft as a cell.
function chance(view, x, y, z, turn, soft) {
  if (view.kind === 'box') {
    const place = [turn[0] * x + turn[1] * y, turn[0] * y - turn[1] * x, z];
    let inside = Infinity;
    for (let axis = 0; axis < view.lower.length; axis += 1) {
      inside = Math.min(inside, place[axis] - view.lower[axis], view.upper[axis] - place[axis]);
    }
    return Math.min(Math.max(0.5 + inside / (2 * soft), 0), 1);
  }
  const [a, b, c = Infinity] = view.size;
  const square = (x / a) ** 2 + (y / b) ** 2 + (z / c) ** 2;
  return Math.exp(-0.5 * (view.kind === 'gaussian' ? square : Math.sqrt(square)));
}

// Multiply what is unexplored by the chance that a look misses it.
function wipe({ corner, step, shape, values }, { view, place }) {
  const isBox = view.kind === 'box';
  if (!isBox && !SIGHT[view.kind]) return;
  const soft = Math.max(view.edge || 0, step[0] / 2);
  const reach = isBox ? soft + Math.hypot(...view.lower.map((low, axis) => Math.max(-low, view.upper[axis]))) : SIGHT[view.kind] * Math.max(...view.size);
  const [first, last] = [-1, 1].map((sign) => shape.map((count, axis) => {
    const index = step[axis] ? (place[axis] + sign * reach - corner[axis]) / step[axis] : 0;
    return sign < 0 ? Math.max(0, Math.ceil(index)) : Math.min(count - 1, Math.floor(index));
  }));
  const turn = isBox && view.turns ? [Math.cos(place[3]), Math.sin(place[3])] : [1, 0];
  const gain = view.gain ?? 1;
  for (let i = first[0]; i <= last[0]; i += 1) {
    for (let j = first[1]; j <= last[1]; j += 1) {
      for (let k = first[2]; k <= last[2]; k += 1) {
        const [x, y] = [corner[0] + i * step[0] - place[0], corner[1] + j * step[1] - place[1]];
        // On a floor heights play no part.
        const z = shape[2] > 1 ? corner[2] + k * step[2] - place[2] : 0;
        values[(i * shape[1] + j) * shape[2] + k] *= 1 - gain * chance(view, x, y, z, turn, soft);
      }
    }
  }
}

export class Unexplored {
  constructor() {
    this.floor = new FloorGrid();
    // Corner and spacing [m], number of cells on each axis, and e of each at the time that is shown.
    this.cells = null;
  }

  update(log, time) {
    const [space] = log.owners('map');
    const event = space !== undefined && log.at('map', space, time);
    this.cells = null;
    if (!event) return;
    const [since, , , corner, step, shape, digits] = event;
    if (this.digits !== digits) Object.assign(this, { digits, published: Float32Array.from(digits, (digit) => digit / 9) });
    const seen = looks(log, time, space, since);
    this.cells = { corner, step, shape, values: seen.length ? this.published.slice() : this.published };
    for (const look of seen) wipe(this.cells, look);
  }

  // Return the mean e of a column.
  mean(i, j) {
    const { shape: [, ny, nz], values } = this.cells;
    let sum = 0;
    for (let k = 0; k < nz; k += 1) sum += values[(i * ny + j) * nz + k];
    return sum / nz;
  }

  draw(view) {
    if (!this.cells) return;
    const colour = themed('--unseen');
    if (this.isSpace(view.camera)) {
      const { context } = view;
      context.fillStyle = `rgb(${colour})`;
      this.each((place, share) => {
        const [x, y] = view.camera.project(place);
        context.globalAlpha = 0.81 * share;
        context.fillRect(x - 2, y - 2, 4, 4);
      });
      context.globalAlpha = 1;
      return;
    }
    // From above a search in space has the mean of each column.
    const { shape: [nx, ny], values } = this.cells;
    if (this.colour !== colour) {
      const colours = Array.from({ length: DARKEST + 1 }, (_, level) => [...colour.split(',').map(Number), level]);
      Object.assign(this, { colour, colours });
    }
    if (this.drawn !== values) {
      this.drawn = values;
      this.levels = Uint8Array.from({ length: nx * ny }, (_, index) => Math.round(DARKEST * this.mean(Math.floor(index / ny), index % ny)));
    }
    this.floor.draw(view, this.cells, this.levels, this.colours);
  }

  isSpace(camera) {
    return camera.spatial && this.cells.shape[2] > 1;
  }

  // Call a function with place and e of each cell that is drawn in space.
  each(visit) {
    const { corner, step, shape: [nx, ny, nz], values } = this.cells;
    const skip = Math.max(1, Math.round(Math.cbrt((nx * ny * nz) / MOST_CELLS)));
    for (let i = 0; i < nx; i += skip) {
      for (let j = 0; j < ny; j += skip) {
        for (let k = 0; k < nz; k += skip) {
          const share = values[(i * ny + j) * nz + k];
          if (share >= FAINTEST) visit([corner[0] + i * step[0], corner[1] + j * step[1], corner[2] + k * step[2]], share);
        }
      }
    }
  }

  // Return place and e of the cell at a point of the canvas; in space of the first that is drawn.
  pick({ camera, floor }, x, y) {
    if (!this.cells) return null;
    const { corner, step, shape } = this.cells;
    if (this.isSpace(camera)) {
      let nearest = null;
      this.each((place, share) => {
        const [px, py, depth] = camera.project(place);
        if (Math.hypot(px - x, py - y) < 5 && !(nearest && nearest.depth < depth)) nearest = { place, share, depth };
      });
      return nearest;
    }
    const place = camera.ground(x, y, floor);
    const [i, j] = place.map((value, axis) => Math.round((value - corner[axis]) / step[axis]));
    if (!(i >= 0 && j >= 0 && i < shape[0] && j < shape[1])) return null;
    return { place, share: this.mean(i, j) };
  }
}
