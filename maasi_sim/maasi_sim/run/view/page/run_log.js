// The events of a run by kind and owner, for binary search by time.

// Statuses of a robot.
export const MOVING = 1;
export const UNAVAILABLE = 5;
export const LEFT = 6;
export const SILENT = 7;
export const ENDED = 8;

// Return the share of a map's letter; NaN where no target can be.
export function shareOf(letter) {
  return parseInt(letter, 36) / 35;
}

export function isAway(robotEvent) {
  return [UNAVAILABLE, LEFT, SILENT].includes(robotEvent[5]);
}

// Whether the service stop holds a robot.
export function isStopped(robotEvent) {
  return robotEvent[5] === UNAVAILABLE && robotEvent[6].includes('stopped by the service stop');
}

export class Slot {
  constructor() {
    this.times = [];
    this.events = [];
  }

  add(time, event) {
    // Almost always at the end; messages of different filters may be slightly out of order.
    let index = this.times.length;
    while (index > 0 && this.times[index - 1] > time) index -= 1;
    if (index === this.times.length) {
      this.times.push(time);
      this.events.push(event);
    } else {
      this.times.splice(index, 0, time);
      this.events.splice(index, 0, event);
    }
  }

  // Number of events at or before a time.
  count(time) {
    let low = 0;
    let high = this.times.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.times[middle] <= time) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  // The last event at a time.
  at(time) {
    const count = this.count(time);
    return count ? this.events[count - 1] : undefined;
  }
}

export class RunLog {
  constructor(scene) {
    this.scene = { robots: {}, ...scene };
    this.slots = new Map();
    this.size = 0;
    this.duration = 0;
    // All robots' decisions, all lines, and the numbers over time.
    this.decisions = new Slot();
    this.lines = new Slot();
    this.totals = new Slot();
    this.potential = new Slot();
    this.explored = new Slot();
    this.left = new Slot();
    this.visits = new Slot();
    this.foundBy = new Map();
    this.potentialBy = new Map();
    this.exploredBy = new Map();
    this.visited = new Set();
  }

  slot(kind, owner) {
    const key = `${kind}/${owner}`;
    let slot = this.slots.get(key);
    if (!slot) {
      slot = new Slot();
      this.slots.set(key, slot);
    }
    return slot;
  }

  at(kind, owner, time) {
    const slot = this.slots.get(`${kind}/${owner}`);
    return slot && slot.at(time);
  }

  // Border, keep-out zones (which may change) and solid polygons.
  zones(time) {
    const event = this.at('zones', '', time);
    return event ? event[3] : this.scene.zones || [];
  }

  // Pose of a robot, interpolated between its states.
  pose(name, time) {
    const slot = this.slot('robot', name);
    const count = slot.count(time);
    if (!count) return undefined;
    const [before, after] = slot.events.slice(count - 1, count + 1);
    if (!after || before[5] !== MOVING || after[5] !== MOVING) return before[3];
    const share = (time - before[0]) / (after[0] - before[0]);
    return before[3].map((value, axis) => {
      const change = after[3][axis] - value;
      return value + share * (axis < 3 ? change : Math.atan2(Math.sin(change), Math.cos(change)));
    });
  }

  owners(kind) {
    const names = [];
    for (const [key, { times }] of this.slots) {
      if (times.length && key.startsWith(`${kind}/`)) names.push(key.slice(kind.length + 1));
    }
    return names.sort();
  }

  robots() {
    return [...new Set([...Object.keys(this.scene.robots), ...this.owners('robot')])].sort();
  }

  add(event) {
    const [time, kind, owner] = event;
    this.size += 1;
    this.duration = Math.max(this.duration, time);
    if (kind === 'scene') {
      Object.assign(this.scene, event[3]);
      return;
    }
    if (kind === 'log') {
      this.lines.add(time, event);
      return;
    }
    this.slot(kind, owner).add(time, event);
    if (kind === 'found') {
      this.foundBy.set(owner, event[3].length);
      this.totals.add(time, [...this.foundBy.values()].reduce((sum, item) => sum + item, 0));
    } else if (kind === 'filter') {
      this.potentialBy.set(owner, event[3]);
      this.potential.add(time, Math.max(...this.potentialBy.values()));
      this.expect(time);
    } else if (kind === 'map') {
      if (event[7] !== null) this.explore(time, owner, event[7]);
    } else if (kind === 'plan') {
      this.explore(time, owner, event[4]);
      for (const robot of event[7]) {
        const decision = { time, event, robot, name: robot[0] };
        this.decisions.add(time, decision);
        this.slot('decision', robot[0]).add(time, decision);
      }
    } else if (kind === 'cuboid') {
      const decision = { time, cuboid: event, name: owner };
      const before = this.slot('decision', owner).at(time);
      this.slot('decision', owner).add(time, decision);
      // One per step; only a changed plan counts.
      if (!before || String(before.cuboid[7]) !== String(event[7])) this.decisions.add(time, decision);
      for (const shot of event[8]) {
        if (this.visited.has(shot[0])) continue;
        this.visited.add(shot[0]);
        this.visits.add(time, { cuboid: shot[0], robot: owner, place: shot.slice(1, 4) });
      }
    }
  }

  explore(time, owner, share) {
    this.exploredBy.set(owner, share);
    this.explored.add(time, Math.max(...this.exploredBy.values()));
    this.expect(time);
  }

  // N0 with the sightings of persons, which each of several filters may count.
  expected(time) {
    const sums = this.owners('report').map((space) => {
      const slot = this.slot('report', space);
      const counted = slot.events.slice(0, slot.count(time));
      return counted.reduce((sum, event) => (event[3] === 'cleared' ? 0 : sum + (event[3] === 'sighting' ? event[7] : 0)), 0);
    });
    return this.scene.expected_targets + Math.max(0, ...sums);
  }

  // Expected number left: potential targets, and N0 times the unexplored share.
  expect(time) {
    const unseen = 1 - (this.explored.at(time) || 0);
    if (this.knowsExpected) this.left.add(time, (this.potential.at(time) || 0) + this.expected(time) * unseen);
  }

  get knowsExpected() {
    return this.scene.expected_targets !== undefined;
  }

  // Number of found targets, or visited cuboids, at a time.
  found(time) {
    return this.isOfBuildings ? this.visits.count(time) : this.totals.at(time) || 0;
  }

  get isOfBuildings() {
    return Boolean(this.scene.cuboids);
  }

  get total() {
    return this.isOfBuildings ? this.scene.cuboids.length : this.scene.targets;
  }

  // The unexplored share at a position, in 2D views the mean of its column; undefined outside.
  unexplored(time, place) {
    const [space] = this.owners('map');
    const event = space !== undefined && this.at('map', space, time);
    if (!event) return undefined;
    const [corner, step, shape, digits] = event.slice(3);
    const [i, j, k] = [0, 1, 2].map((axis) => Math.round((place[axis] - corner[axis]) / (step[axis] || 1)));
    if (!(i >= 0 && j >= 0 && i < shape[0] && j < shape[1])) return undefined;
    const column = digits.substr((i * shape[1] + j) * shape[2], shape[2]);
    const cells = column[k] === undefined || shape[2] === 1 ? [...column] : [column[k]];
    return cells.reduce((sum, letter) => sum + (shareOf(letter) || 0), 0) / cells.length;
  }

  measurements(time) {
    let sum = 0;
    for (const space of this.owners('filter')) {
      const event = this.at('filter', space, time);
      if (event) sum = Math.max(sum, event[5]);
    }
    return sum;
  }

  // Bounds of the environment, or of its known part.
  get bounds() {
    if (this.scene.bounds) return this.scene.bounds;
    const low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    for (const name of this.owners('robot')) {
      for (const event of this.slot('robot', name).events) {
        for (let axis = 0; axis < 3; axis += 1) {
          low[axis] = Math.min(low[axis], event[3][axis]);
          high[axis] = Math.max(high[axis], event[3][axis]);
        }
      }
    }
    if (low[0] > high[0]) return [[0, 1], [0, 1]];
    return [0, 1].map((axis) => [low[axis] - 1, high[axis] + 1]);
  }

  get isSpatial() {
    return this.bounds.length === 3;
  }
}

// Return the log inside a replay: JSON lines, compressed, in base64.
export async function unpack(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip'));
  const lines = (await new Response(stream).text()).split('\n');
  const log = new RunLog(JSON.parse(lines[0]));
  for (const line of lines.slice(1)) log.add(JSON.parse(line));
  return log;
}
