// Draws the map at a time.

import { Belief } from './belief.js';
import { FOUND, KEEP_OUT, POTENTIAL, SEEN, objectiveColours, robotColour, themed } from './colours.js';
import { Labels } from './labels.js';
import { Background, drawNorth, drawScale } from './map_frame.js';
import { drawRobot, drawWays } from './robots.js';
import { LEFT } from './run_log.js';
import { drawReports } from './statements.js';
import { circle, corners, cross, dropLine, edges, ellipse, matrix, path, trace } from './shapes.js';
import { number } from './text.js';
import { Unexplored } from './unexplored.js';
import { drawBuildings } from './buildings.js';

// Display time of detections [s].
const FADE = 1.5;
// Largest radius of the ring around a new find [px].
const PULSE_REACH = 40;

export class MapView {
  constructor(canvas, camera, onReady) {
    this.canvas = canvas;
    this.context = canvas.getContext('2d');
    this.camera = camera;
    this.layers = { background: true, truth: true, unseen: true, left: false, belief: false, view: true, ways: true, clusters: true, detections: true };
    this.marked = null;
    // Display time of the ring around a new find [s of the run].
    this.pulse = 0;
    this.unexplored = new Unexplored();
    this.belief = new Belief();
    this.background = new Background(onReady);
    // Screen positions of robots and candidates, for clicks.
    this.targets = [];
  }

  resize() {
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth, clientHeight } = this.canvas;
    const [width, height] = [Math.round(clientWidth * ratio), Math.round(clientHeight * ratio)];
    if (this.canvas.width === width && this.canvas.height === height) return;
    [this.canvas.width, this.canvas.height] = [width, height];
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.camera.width = clientWidth;
    this.camera.height = clientHeight;
  }

  draw(log, time, selected) {
    const { context, camera } = this;
    this.targets = [];
    this.labels = new Labels();
    this.names = log.robots();
    this.floor = log.isSpatial ? log.bounds[2][0] : 0;
    context.globalAlpha = 1;
    context.setLineDash([]);
    context.fillStyle = themed('--back');
    context.fillRect(0, 0, camera.width, camera.height);
    this.drawGround(log);
    this.unexplored.update(log, time);
    if (this.layers.unseen) this.unexplored.draw(this);
    if (this.layers.left) this.unexplored.drawLeft(this);
    if (this.layers.belief && !log.isOfBuildings) this.belief.draw(this, log, time);
    this.drawZones(log, time);
    this.drawObstacles(log);
    this.drawFences(log);
    drawReports(this, log, time);
    if (log.isOfBuildings || log.scene.objects) drawBuildings(this, log, time);
    if (this.layers.ways) drawWays(this, log, time);
    if (this.layers.clusters) this.drawClusters(log, time);
    if (this.layers.detections) this.drawDetections(log, time);
    this.drawFound(log, time);
    if (this.layers.truth) this.drawTruth(log, time);
    if (selected) this.drawCandidates(log, time, selected);
    for (const name of this.names) drawRobot(this, log, time, name, name === selected);
    drawNorth(this, log.bounds);
    drawScale(this, this.gridStep);
    this.labels.draw(context, camera.width, camera.height);
  }

  drawGround(log) {
    const { context, camera } = this;
    const [[left, right], [low, high]] = log.bounds;
    context.fillStyle = themed('--floor');
    context.strokeStyle = themed('--line');
    context.lineWidth = 1;
    path(context, camera, corners(log.bounds, this.floor), true);
    context.fill();
    context.stroke();
    if (this.layers.background) this.background.draw(this, log.scene);
    const step = niceStep(Math.max(right - left, high - low) / 8);
    context.globalAlpha = 0.5;
    for (let x = Math.ceil(left / step) * step; x <= right; x += step) {
      path(context, camera, [[x, low, this.floor], [x, high, this.floor]]);
      context.stroke();
    }
    for (let y = Math.ceil(low / step) * step; y <= high; y += step) {
      path(context, camera, [[left, y, this.floor], [right, y, this.floor]]);
      context.stroke();
    }
    context.globalAlpha = 1;
    if (log.isSpatial && camera.spatial) edges(context, camera, log.bounds, log.bounds[2]);
    this.gridStep = step;
  }

  // The border of the area, keep-out zones and solid polygons.
  drawZones(log, time) {
    const { context, camera } = this;
    for (const { kind, rings } of log.zones(time)) {
      const colour = kind === 'keep_out' ? KEEP_OUT : themed({ area: '--text', obstacle: '--quiet' }[kind]);
      const heights = camera.spatial && log.isSpatial ? log.bounds[2] : [this.floor];
      for (const z of heights) {
        context.beginPath();
        for (const ring of rings) trace(context, camera, ring.map(([x, y]) => [x, y, z]));
        context.fillStyle = colour;
        context.strokeStyle = colour;
        context.globalAlpha = { area: 0, keep_out: 0.22, obstacle: 0.85 }[kind];
        if (kind !== 'area') context.fill('evenodd');
        context.globalAlpha = 1;
        if (kind === 'keep_out') {
          context.fillStyle = this.hatch ||= hatched(context, colour);
          context.fill('evenodd');
        }
        context.lineWidth = { area: 2, keep_out: 1.5, obstacle: 1 }[kind];
        context.stroke();
      }
    }
    context.lineWidth = 1;
  }

  drawObstacles(log) {
    const { context, camera } = this;
    const keptAway = Math.max(0, ...Object.values(log.scene.robots).map((robot) => robot.clearance || 0));
    for (const obstacle of log.scene.obstacles || []) {
      const radius = obstacle[obstacle.length - 1];
      const place = obstacle.length === 4 ? obstacle.slice(0, 3) : [...obstacle.slice(0, 2), this.floor];
      context.fillStyle = themed('--quiet');
      context.strokeStyle = themed('--text');
      if (obstacle.length === 4) {
        const variance = radius * radius;
        ellipse(context, camera, place, matrix([variance, 0, 0, variance, 0, variance]), 1);
      } else path(context, camera, circle(place, radius), true);
      context.globalAlpha = 0.85;
      context.fill();
      context.stroke();
      if (camera.spatial && log.isSpatial && obstacle.length === 3) {
        path(context, camera, circle([place[0], place[1], log.bounds[2][1]], radius), true);
        context.globalAlpha = 0.4;
        context.fill();
        context.stroke();
      }
      context.globalAlpha = 0.8;
      if (keptAway) {
        context.setLineDash([3, 3]);
        path(context, camera, circle(place, radius + keptAway), true);
        context.stroke();
        context.setLineDash([]);
      }
      context.globalAlpha = 1;
    }
  }

  // Geofences of robots, in their colours.
  drawFences(log) {
    const { context, camera } = this;
    context.setLineDash([8, 3, 2, 3]);
    context.globalAlpha = 0.7;
    for (const name of this.names) {
      const { fence } = log.scene.robots[name] || {};
      if (!fence) continue;
      context.strokeStyle = robotColour(this.names, name);
      edges(context, camera, fence, camera.spatial ? fence[2] : [this.floor]);
    }
    context.setLineDash([]);
    context.globalAlpha = 1;
  }

  drawClusters(log, time) {
    const { context, camera } = this;
    for (const space of log.owners('filter')) {
      const event = log.at('filter', space, time);
      if (!event) continue;
      for (const cluster of event[4]) {
        const [x, y, z, mass, ...covariance] = cluster;
        const share = Math.min(mass, 1);
        ellipse(context, camera, [x, y, z], matrix(covariance), 2, 3);
        context.fillStyle = POTENTIAL;
        context.strokeStyle = POTENTIAL;
        context.globalAlpha = 0.12 + 0.3 * share;
        context.fill();
        context.globalAlpha = 0.35 + 0.65 * share;
        context.lineWidth = 1.5;
        context.stroke();
        dropLine(context, camera, [x, y, z], this.floor);
        context.globalAlpha = 1;
        const [px, py] = camera.project([x, y, z]);
        if (mass >= 0.05) this.labels.add(number(mass), px, py);
        this.targets.push({ x: px, y: py, cluster });
      }
    }
  }

  drawDetections(log, time) {
    const { context, camera } = this;
    context.strokeStyle = SEEN;
    for (const name of this.names) {
      const slot = log.slot('seen', name);
      for (let index = slot.count(time) - 1; index >= 0 && slot.times[index] > time - FADE; index -= 1) {
        const [when, , , from, detections] = slot.events[index];
        context.globalAlpha = 0.9 * (1 - (time - when) / FADE) + 0.1;
        for (const [range, bearing, elevation, alongRange, alongBearing, alongElevation] of detections) {
          const level = range * Math.cos(elevation);
          const out = [Math.cos(bearing), Math.sin(bearing)];
          const height = log.isSpatial ? from[2] + range * Math.sin(elevation) : 0;
          const place = [from[0] + level * out[0], from[1] + level * out[1], height];
          const basis = [
            [Math.cos(elevation) * out[0], Math.cos(elevation) * out[1], Math.sin(elevation), alongRange],
            [-out[1], out[0], 0, level * alongBearing],
            [-Math.sin(elevation) * out[0], -Math.sin(elevation) * out[1], Math.cos(elevation), log.isSpatial ? range * alongElevation : 0],
          ];
          const covariance = [0, 1, 2].map((i) => [0, 1, 2].map((j) => basis.reduce((sum, row) => sum + row[i] * row[j] * row[3] * row[3], 0)));
          ellipse(context, camera, place, covariance, 1, 2);
          context.stroke();
          const [x, y] = camera.project(place);
          cross(context, x, y, 3);
        }
      }
    }
    context.globalAlpha = 1;
  }

  drawFound(log, time) {
    const { context, camera } = this;
    for (const space of log.owners('found')) {
      const event = log.at('found', space, time);
      if (!event) continue;
      for (const found of event[3]) {
        const [id, x, y, z, covariance, , when] = found;
        context.strokeStyle = FOUND;
        context.fillStyle = FOUND;
        context.lineWidth = 2;
        ellipse(context, camera, [x, y, z], matrix(covariance), 3, 4);
        context.stroke();
        const [px, py] = camera.project([x, y, z]);
        context.beginPath();
        context.arc(px, py, 3, 0, 2 * Math.PI);
        context.fill();
        dropLine(context, camera, [x, y, z], this.floor);
        if (time - when < this.pulse) {
          const age = Math.max(0, (time - when) / this.pulse);
          context.globalAlpha = 1 - age;
          context.lineWidth = 3;
          context.beginPath();
          context.arc(px, py, 6 + PULSE_REACH * age, 0, 2 * Math.PI);
          context.stroke();
          context.globalAlpha = 1;
        }
        this.labels.add(String(id), px, py, { font: '12px system-ui, sans-serif', away: 8 });
        this.targets.push({ x: px, y: py, found });
      }
    }
    context.lineWidth = 1;
  }

  drawTruth(log, time) {
    const event = log.at('truth', '', time);
    if (!event) return;
    const { context, camera } = this;
    context.strokeStyle = themed('--text');
    context.lineWidth = 1.5;
    for (const place of event[3]) {
      const [x, y] = camera.project(place);
      cross(context, x, y, 5);
      this.targets.push({ x, y, truth: place });
      dropLine(context, camera, place, this.floor);
    }
    context.lineWidth = 1;
  }

  drawCandidates(log, time, name) {
    const decision = log.at('decision', name, time);
    const state = log.at('robot', name, time);
    if (!decision || !decision.robot || (state && state[5] === LEFT)) return;
    const { context, camera } = this;
    const [, , chosen, , candidates] = decision.robot;
    const colours = objectiveColours(candidates);
    candidates.forEach((item, index) => {
      const [x, y] = camera.project(item);
      const size = index === chosen ? 8 : 5.5;
      context.beginPath();
      context.arc(x, y, size, 0, 2 * Math.PI);
      if (colours[index]) {
        context.fillStyle = colours[index];
        context.fill();
      }
      context.lineWidth = index === chosen || index === this.marked ? 3 : 1;
      context.strokeStyle = index === this.marked ? SEEN : themed('--text');
      context.stroke();
      this.targets.push({ x, y, candidate: index });
    });
    context.lineWidth = 1;
  }

  // Return the item at a point of the canvas: robots first, true targets last.
  hit(x, y) {
    const near = this.targets
      .map((item) => ({ ...item, distance: Math.hypot(item.x - x, item.y - y) }))
      .filter((item) => item.distance < 16)
      .sort((a, b) => rank(a) - rank(b) || a.distance - b.distance);
    return near[0];
  }
}

// Return a pattern of slanted lines.
function hatched(context, colour) {
  const tile = document.createElement('canvas');
  [tile.width, tile.height] = [8, 8];
  const lines = tile.getContext('2d');
  lines.strokeStyle = colour;
  lines.lineWidth = 1.5;
  for (const shift of [-8, 0, 8]) {
    lines.moveTo(shift - 1, 9);
    lines.lineTo(shift + 9, -1);
  }
  lines.stroke();
  return context.createPattern(tile, 'repeat');
}

function rank(item) {
  if (item.robot !== undefined) return 0;
  return item.truth ? 2 : 1;
}

// Return a step of 1, 2 or 5 times a power of ten near a length.
function niceStep(length) {
  const power = 10 ** Math.floor(Math.log10(length));
  return power * [1, 2, 5, 10].find((factor) => factor * power >= length);
}
