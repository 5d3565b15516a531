// Draws an area and keep-out zones on the map and saves them for the next run.

import { KEEP_OUT, themed } from './colours.js';
import { onEarth } from './earth.js';
import { path } from './shapes.js';
import { button, counted, element } from './text.js';

const SHAPES = { area: 'area', keep_out: 'keep-out' };
const FILE = 'area.geojson';
// A click this close to the first or last corner closes a ring [px].
const CLOSING = 9;

export class Drawing {
  constructor(tools, status, page) {
    this.status = status;
    this.page = page;
    // Kind that clicks draw, or null.
    this.kind = null;
    // Shapes to save, beginning with those of the run; null before the first drawing.
    this.shapes = null;
    this.corners = [];
    const actions = [
      ['area', 'Draw area', () => this.start('area')],
      ['keep_out', 'Draw keep-out zone', () => this.start('keep_out')],
      ['undo', 'Undo', () => this.undo()],
      ['save', 'Save', () => this.save()],
    ];
    this.buttons = actions.map(([draw, title, action]) => button(title, () => {
      this.shapes ||= shapesOf(page.log, page.time);
      action();
    }, { draw }));
    tools.append(...this.buttons);
  }

  // Toggle drawing by clicks.
  start(kind) {
    this.kind = this.kind === kind ? null : kind;
    if (this.kind && this.page.reports.kind) this.page.reports.start(null);
    this.tell();
  }

  // Add a corner at a point of the canvas, or close the ring.
  click(x, y) {
    const { camera, map } = this.page;
    const isNear = (corner) => {
      const [px, py] = camera.project([...corner, map.floor]);
      return Math.hypot(px - x, py - y) < CLOSING;
    };
    const problem = problemOf(this.corners);
    if (!this.corners.slice(0, 1).concat(this.corners.slice(-1)).some(isNear)) {
      this.corners.push(camera.ground(x, y, map.floor).map((value) => Number(value.toFixed(4))));
    } else if (problem) {
      this.tell(`This ${SHAPES[this.kind]} cannot be closed: ${problem}.`);
      return;
    } else {
      this.shapes.push({ kind: this.kind, drawn: true, rings: [[...this.corners, this.corners[0]]] });
      this.corners = [];
      this.kind = null;
    }
    this.tell();
  }

  // Undo the last corner or shape; the area of the run stays.
  undo() {
    const last = this.shapes.at(-1);
    if (this.corners.length) this.corners.pop();
    else if (last.drawn || last.kind !== 'area') this.shapes.pop();
    this.tell();
  }

  // Shapes to save: the last drawn area replaces that of the run.
  get kept() {
    const area = this.shapes.filter(({ kind, drawn }) => kind === 'area' && drawn).at(-1);
    return this.shapes.filter((item) => item.kind !== 'area' || !area || item === area);
  }

  save() {
    if (this.corners.length) {
      this.tell('Not saved: close the open shape or undo its corners first.');
      return;
    }
    const { bounds, scene: { origin } } = this.page.log;
    const place = (corner) => (origin ? onEarth(corner, origin) : corner);
    const features = this.kept.map(({ kind, rings }) => ({
      type: 'Feature',
      properties: { role: kind, ...(origin ? { origin } : { unit: 'm' }) },
      geometry: { type: 'Polygon', coordinates: rings.map((ring) => ring.map(place)) },
    }));
    const text = JSON.stringify({ type: 'FeatureCollection', features });
    const link = element('a');
    link.href = URL.createObjectURL(new Blob([text], { type: 'application/geo+json' }));
    link.download = FILE;
    link.click();
    const altitude = bounds[2] ? `, altitude: [${bounds[2].join(', ')}]` : '';
    this.tell(`Saved. Use it in a scenario: environment: {area: ${FILE}${altitude}}.`);
  }

  // Show a message, the drawn shapes and the next step.
  tell(news = '') {
    const area = this.kept.some(({ drawn, kind }) => drawn && kind === 'area') ? 'New area' : 'Area of the run';
    const closed = this.kept.filter(({ kind }) => kind === 'keep_out').length;
    const hint = `Corners of the ${SHAPES[this.kind]}: ${this.corners.length}. Click to add a corner; double-click or click the first corner to close.`;
    this.status.textContent = `${news} ${area}, ${counted(closed, 'keep-out zone')}. ${this.kind ? hint : ''}`;
    this.status.hidden = false;
    for (const each of this.buttons.slice(0, 2)) each.setAttribute('aria-pressed', String(this.kind === each.dataset.draw));
    this.page.request();
  }

  draw({ canvas, context, camera, floor }) {
    canvas.style.cursor = this.kind ? 'crosshair' : '';
    const open = { kind: this.kind || 'area', rings: [this.corners] };
    context.lineWidth = 2.5;
    for (const { kind, rings } of this.shapes ? [...this.kept, open] : []) {
      context.strokeStyle = kind === 'area' ? themed('--accent') : KEEP_OUT;
      for (const ring of rings) {
        path(context, camera, ring.map(([x, y]) => [x, y, floor]));
        context.stroke();
      }
    }
    for (const corner of this.corners) {
      const [x, y] = camera.project([...corner, floor]);
      context.strokeRect(x - 3.5, y - 3.5, 7, 7);
    }
    context.lineWidth = 1;
  }
}

// Return area and keep-out zones of a run; its bounds if it has no polygon.
function shapesOf(log, time) {
  const zones = log.zones(time).filter(({ kind }) => kind in SHAPES);
  if (zones.some(({ kind }) => kind === 'area')) return zones;
  const [[left, right], [low, high]] = log.bounds;
  return [{ kind: 'area', rings: [[[left, low], [right, low], [right, high], [left, high], [left, low]]] }, ...zones];
}

// Return the problem of a ring's corners, or an empty text.
export function problemOf(corners) {
  const count = corners.length;
  if (count < 3) return `it needs at least 3 corners and has ${count}`;
  const side = ([ax, ay], [bx, by], [cx, cy]) => Math.sign((bx - ax) * (cy - ay) - (by - ay) * (cx - ax));
  const turnsBack = (a, b, c) => side(a, b, c) === 0 && (a[0] - b[0]) * (c[0] - b[0]) + (a[1] - b[1]) * (c[1] - b[1]) > 0;
  for (let i = 0; i < count; i += 1) {
    const [a, b, next] = [0, 1, 2].map((step) => corners[(i + step) % count]);
    let isCrossed = turnsBack(a, b, next);
    for (let j = i + 2; j < (i === 0 ? count - 1 : count); j += 1) {
      const [c, d] = [corners[j], corners[(j + 1) % count]];
      isCrossed ||= side(a, b, c) !== side(a, b, d) && side(c, d, a) !== side(c, d, b);
    }
    if (isCrossed) return `side ${i + 1} crosses another side; undo corners`;
  }
  return '';
}
