// Potential targets as a heat map: density from their Gaussians.

import { FloorGrid } from './floor_grid.js';
import { number } from './text.js';

// Cells along the longer side; colours; cut-off of a Gaussian [deviations].
const BELIEF_CELLS = 90;
const LEVELS = 24;
const REACH = 3.5;

export class Belief {
  constructor() {
    const shade = (share, low, high) => [...low.map((value, index) => value + share * (high[index] - value)), share && 60 + 170 * share];
    this.floor = new FloorGrid(LEVELS, ['--heat-low', '--heat-high'], shade, true);
    this.events = [];
  }

  // Compute the density [targets/m^2] from the filters' last updates; the largest of several filters.
  update(log, time) {
    const events = log.owners('filter').map((space) => log.at('filter', space, time)).filter(Boolean);
    if (this.bounds === log.bounds && events.length === this.events.length && events.every((event, index) => event === this.events[index])) return;
    Object.assign(this, { events, bounds: log.bounds });
    const size = [0, 1].map((axis) => log.bounds[axis][1] - log.bounds[axis][0]);
    const side = Math.max(...size) / BELIEF_CELLS;
    const shape = size.map((length) => Math.max(1, Math.round(length / side)));
    const step = size.map((length, axis) => length / shape[axis]);
    this.cells = { corner: [0, 1].map((axis) => log.bounds[axis][0] + step[axis] / 2), step, shape };
    this.density = new Float32Array(shape[0] * shape[1]);
    let highest = 0;
    for (const event of events) {
      const own = new Float32Array(this.density.length);
      for (const cluster of event[4]) highest = Math.max(highest, this.add(own, cluster));
      for (let index = 0; index < own.length; index += 1) this.density[index] = Math.max(this.density[index], own[index]);
    }
    // Darkest for a whole target as certain as the most certain one.
    this.levels = new Uint8Array(this.density.length);
    this.isEmpty = highest === 0;
    for (let index = 0; index < this.levels.length && !this.isEmpty; index += 1) {
      this.levels[index] = Math.round(LEVELS * Math.sqrt(Math.min(this.density[index] / highest, 1)));
    }
  }

  // Add a potential target, seen from above; return the peak density of a whole one.
  add(density, [px, py, , mass, xx, xy, , yy]) {
    const { corner, step, shape } = this.cells;
    // At least one cell wide, so that none is missed.
    const [a, b, c] = [xx + step[0] ** 2 / 4, xy, yy + step[1] ** 2 / 4];
    const determinant = Math.max(a * c - b * b, 1e-12);
    const top = 1 / (2 * Math.PI * Math.sqrt(determinant));
    const [[left, right], [low, high]] = [[px, a], [py, c]].map(([middle, variance], axis) => [-1, 1].map((sign) => {
      const index = Math.round((middle + sign * REACH * Math.sqrt(variance) - corner[axis]) / step[axis]);
      return Math.min(Math.max(index, 0), shape[axis] - 1);
    }));
    for (let i = left; i <= right; i += 1) {
      for (let j = low; j <= high; j += 1) {
        const [x, y] = [corner[0] + i * step[0] - px, corner[1] + j * step[1] - py];
        const square = (c * x * x - 2 * b * x * y + a * y * y) / determinant;
        density[i * shape[1] + j] += mass * top * Math.exp(-0.5 * square);
      }
    }
    return top;
  }

  draw(view, log, time) {
    this.update(log, time);
    if (!this.isEmpty) this.floor.draw(view, this.cells, this.levels);
  }

  // Return the density at a position as text.
  words(place) {
    const { corner, step, shape } = this.cells;
    const [i, j] = [0, 1].map((axis) => Math.round((place[axis] - corner[axis]) / step[axis]));
    return `potential ${number(this.density[i * shape[1] + j] || 0)} targets per m²`;
  }
}
