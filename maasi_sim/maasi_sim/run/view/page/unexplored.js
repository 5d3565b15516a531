// The unexplored area: the last published map, updated with the measurements since, as in the
// planner: each measurement multiplies the e of a cell by 1 - pi. Multiplied by the prior it gives
// the expected undetected targets.

import { themed } from './colours.js';
import { FloorGrid } from './floor_grid.js';
import { isAway, shareOf } from './run_log.js';
import { number } from './text.js';

// Range of the detection probability, in sizes of a sensor.
const SIGHT = { exponential: 7, gaussian: 3 };
// Largest opacity of a cell, up to 255; cells below this e are not drawn in space.
const DARKEST = 135;
const FAINTEST = 0.06;
// Undetected targets: number of shades and largest opacity.
const LEFT_SHADES = 40;
const DARKEST_LEFT = 165;
// Most drawn cells in 3D.
const MOST_CELLS = 3000;

// Return the poses of measurements since a time and the current poses, with their sensors.
function looks(log, time, space, since) {
  // The map of a robot with its own planner contains only its own measurements.
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

// Return the detection probability at an offset; the edge of a box is one cell wide.
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

// Multiply e by the probability of a missed detection.
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
        // In 2D heights are ignored.
        const z = shape[2] > 1 ? corner[2] + k * step[2] - place[2] : 0;
        values[(i * shape[1] + j) * shape[2] + k] *= 1 - gain * chance(view, x, y, z, turn, soft);
      }
    }
  }
}

export class Unexplored {
  constructor() {
    this.floor = new FloorGrid(DARKEST, ['--unseen'], (share, colour) => [...colour, DARKEST * share]);
    this.leftFloor = new FloorGrid(LEFT_SHADES, ['--left'], (share, colour) => [...colour, DARKEST_LEFT * share]);
    // Corner and spacing [m], number of cells on each axis, and e at the shown time.
    this.cells = null;
  }

  update(log, time) {
    const [space] = log.owners('map');
    const event = space !== undefined && log.at('map', space, time);
    this.cells = null;
    if (!event) return;
    const [since, , , corner, step, shape, digits] = event;
    if (this.digits !== digits || this.scene !== log.scene) {
      const published = Float32Array.from(digits, shareOf);
      const [nx, ny, nz] = shape;
      // Of open cells; those along the bounds are half as wide.
      const weight = (share, index) => !Number.isNaN(share) * (Math.floor(index / (ny * nz)) % (nx - 1) ? 1 : 0.5) * ((Math.floor(index / nz) % ny) % (ny - 1) ? 1 : 0.5);
      Object.assign(this, { digits, scene: log.scene, weights: Float32Array.from(published, weight) });
      this.published = published.map((share) => share || 0);
      this.expect(log.scene, corner, step, shape);
    }
    const seen = looks(log, time, space, since);
    this.cells = { corner, step, shape, values: seen.length ? this.published.slice() : this.published };
    for (const look of seen) wipe(this.cells, look);
  }

  // Compute the expected targets in each column before the search [1/m^2 of ground].
  expect({ prior, expected_targets: targets }, corner, step, shape) {
    const [nx, ny, nz] = shape;
    this.before = new Float32Array(nx * ny);
    let whole = 0;
    for (let i = 0; i < nx; i += 1) {
      for (let j = 0; j < ny; j += 1) {
        const weight = this.weights[(i * ny + j) * nz];
        if (!weight) continue;
        let likely = 1;
        if (prior) {
          const [low, width, size, values] = prior;
          const [a, b] = [i, j].map((index, axis) => Math.min(Math.max(Math.round((corner[axis] + index * step[axis] - low[axis]) / width[axis]), 0), size[axis] - 1));
          likely = values[a * size[1] + b];
        }
        this.before[i * ny + j] = likely;
        whole += likely * weight;
      }
    }
    const scale = (targets || 1) / (whole * step[0] * step[1] || 1);
    this.before = this.before.map((likely) => likely * scale);
    this.most = this.before.reduce((most, value) => Math.max(most, value), 0);
    // Small numbers are hard to read.
    const ground = nx * ny * step[0] * step[1];
    this.unit = [[1, 'm²', 1e3], [1e4, 'ha', 1e8], [1e6, 'km²', Infinity]].find(([, , limit]) => ground < limit);
  }

  // Return a target density [1/m^2] as text.
  amount(density) {
    return `${number(density * this.unit[0])} expected targets per ${this.unit[1]}`;
  }

  // Return the explored share of the open ground.
  get searched() {
    if (!this.cells) return undefined;
    const { values } = this.cells;
    const whole = this.weights.reduce((sum, weight) => sum + weight, 0);
    return whole ? this.weights.reduce((sum, weight, index) => sum + weight * (1 - values[index]), 0) / whole : undefined;
  }

  // Return the searchable ground [m^2].
  get ground() {
    const { shape: [, , nz], step } = this.cells;
    return this.weights.reduce((sum, weight, index) => (index % nz ? sum : sum + weight), 0) * step[0] * step[1];
  }

  // Return the mean e of a column.
  mean(i, j) {
    const { shape: [, ny, nz], values } = this.cells;
    let sum = 0;
    for (let k = 0; k < nz; k += 1) sum += values[(i * ny + j) * nz + k];
    return sum / nz;
  }

  // Draw the expected undetected targets on the floor.
  drawLeft(view) {
    if (!this.cells || !this.most) return;
    const { shape: [, ny], values } = this.cells;
    if (this.leftOf !== values) {
      this.leftOf = values;
      this.leftLevels = Uint8Array.from(this.before, (before, index) => Math.round(LEFT_SHADES * Math.sqrt((before * this.mean(Math.floor(index / ny), index % ny)) / this.most)));
    }
    this.leftFloor.draw(view, this.cells, this.leftLevels);
  }

  draw(view) {
    if (!this.cells) return;
    if (this.isSpace(view.camera)) {
      const { context } = view;
      context.fillStyle = `rgb(${themed('--unseen')})`;
      this.each((place, share) => {
        const [x, y] = view.camera.project(place);
        context.globalAlpha = 0.81 * share;
        context.fillRect(x - 2, y - 2, 4, 4);
      });
      context.globalAlpha = 1;
      return;
    }
    // From above a 3D search shows the mean of each column.
    const { shape: [nx, ny], values } = this.cells;
    if (this.drawn !== values) {
      this.drawn = values;
      this.levels = Uint8Array.from({ length: nx * ny }, (_, index) => Math.round(DARKEST * this.mean(Math.floor(index / ny), index % ny)));
    }
    this.floor.draw(view, this.cells, this.levels);
  }

  isSpace(camera) {
    return camera.spatial && this.cells.shape[2] > 1;
  }

  // Call a function with position and e of each drawn cell in 3D.
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

  // Return position, e and expected undetected targets of the (in 3D frontmost) cell at a point of
  // the canvas, or nothing where no target can be.
  pick({ camera, floor }, x, y) {
    if (!this.cells) return null;
    const { corner, step, shape } = this.cells;
    if (this.isSpace(camera)) {
      let nearest = null;
      this.each((place, share) => {
        const [px, py, depth] = camera.project(place);
        if (Math.hypot(px - x, py - y) < 5 && !(nearest && nearest.depth < depth)) nearest = { place, share, depth };
      });
      if (!nearest) return null;
      const [a, b] = [0, 1].map((axis) => Math.round((nearest.place[axis] - corner[axis]) / step[axis]));
      return { ...nearest, left: this.before[a * shape[1] + b] * this.mean(a, b) };
    }
    const place = camera.ground(x, y, floor);
    const [i, j] = place.map((value, axis) => Math.round((value - corner[axis]) / step[axis]));
    if (!(i >= 0 && j >= 0 && i < shape[0] && j < shape[1])) return null;
    const column = i * shape[1] + j;
    if (!this.weights[column * shape[2]]) return null;
    return { place, share: this.mean(i, j), left: this.before[column] * this.mean(i, j) };
  }
}
