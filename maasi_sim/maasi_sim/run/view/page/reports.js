// Found targets with buttons, and tools with which persons state what they know.

import { SIGHTED, VISITED } from './colours.js';
import { problemOf } from './drawing.js';
import { inMap, onEarth } from './earth.js';
import { send } from './live.js';
import { circle, path } from './shapes.js';
import { reportsAt } from './statements.js';
import { button, counted, element, number } from './text.js';

const TOOLS = { sighting: 'Add sighting', searched: 'Mark searched' };
const PROMPTS = {
  sighting: 'Click where the target or the clue was.',
  searched: 'Click the corners of the ground that others have searched.',
};
// Fields of a statement: name, title, hint, and first value.
const FIELDS = {
  sighting: [
    ['radius', 'radius [m]', 'contains the target with 86 %', ''],
    ['weight', 'expected targets', '0.5: every second sighting of this kind is true', '0.5'],
  ],
  searched: [['detection_probability', 'probability of detection', 'of a target in this ground', '0.7']],
};

// Return the found targets of a filter, and those that persons rejected.
function findsOf(log, space, time) {
  const event = log.at('found', space, time);
  const found = event ? event[3] : [];
  const reviews = new Map();
  for (const report of reportsAt(log, space, time)) {
    if (report[4]) reviews.set(report[4], [...(reviews.get(report[4]) || []), report]);
  }
  const rows = found.map(([id, x, y, z, , robot, when]) => ({ space, id, place: [x, y, z], robot, when, reviews: reviews.get(id) || [], counts: true }));
  for (const [id, given] of reviews) {
    if (!found.some((row) => row[0] === id)) rows.push({ space, id, place: given.at(-1)[5], reviews: given, counts: false });
  }
  const crops = new Map(log.slot('crop', space).events.map((crop) => [crop[3], crop[4]]));
  for (const row of rows) row.picture = crops.get(row.id);
  return rows.sort((one, other) => one.id - other.id);
}

// Return corners [m] as text: latitude and longitude if there is an origin.
function asText(corners, origin) {
  const words = ([x, y]) => (origin ? onEarth([x, y], origin).reverse().map((angle) => angle.toFixed(7)) : [x, y]).join(', ');
  return corners.map(words).join('; ');
}

// Return the corners [m] of a text, or null.
function fromText(text, origin) {
  const pairs = text.split(';').map((part) => part.trim()).filter(Boolean).map((part) => part.split(/[\s,]+/).map(Number));
  if (!pairs.every((pair) => pair.length === 2 && pair.every(Number.isFinite))) return null;
  if (!origin) return pairs;
  if (!pairs.every(([latitude, longitude]) => Math.abs(latitude) <= 90 && Math.abs(longitude) <= 180)) return null;
  return pairs.map((pair) => inMap(pair.reverse(), origin).map((value) => Number(value.toFixed(3))));
}

function stateOfFind({ counts, reviews, robot, when }) {
  const words = counts ? [`${robot}, ${Math.round(when)} s`] : ['rejected'];
  const confirmed = reviews.filter((report) => report[3] === 'confirmed').length;
  const rejected = reviews.length - confirmed;
  if (confirmed) words.push(`confirmed ${counted(confirmed, 'time')}`);
  if (rejected && counts) words.push(`rejected ${counted(rejected, 'time')}`);
  return words.join(', ');
}

export class Reports {
  constructor(tools, panel, section, page) {
    [this.panel, this.section, this.page] = [panel, section, page];
    // Statement that clicks draw, or null.
    this.kind = null;
    this.corners = [];
    this.person = element('input');
    this.person.placeholder = 'your name';
    this.person.maxLength = 100;
    this.person.setAttribute('aria-label', 'Your name');
    section.querySelector('p').append('Statements by ', this.person);
    this.buttons = Object.entries(TOOLS).map(([report, title]) => button(title, () => this.start(report), { report }));
    tools.append(...this.buttons);
    this.enable(false);
  }

  // Whether persons can state something: during a live run with controls.
  enable(enabled) {
    this.enabled = enabled;
    for (const tool of this.buttons) tool.hidden = !enabled;
    this.section.querySelector('p').hidden = !enabled;
    if (!enabled && this.kind) this.start(null);
  }

  // Toggle a statement whose position or corners are clicked.
  start(kind) {
    this.kind = this.kind === kind ? null : kind;
    this.corners = [];
    if (this.kind && this.page.drawing.kind) this.page.drawing.start(null);
    for (const tool of this.buttons) tool.setAttribute('aria-pressed', String(tool.dataset.report === this.kind));
    this.panel.hidden = !this.kind;
    if (this.kind) this.fillPanel();
    this.changed();
  }

  // Enable buttons by what is there at once, not with the next drawing: a click may come before it.
  changed() {
    if (this.kind) {
      const problem = this.problem();
      this.sender.disabled = Boolean(problem);
      this.undo.disabled = !this.corners.length;
      this.status.textContent = problem;
    }
    this.page.request();
  }

  fillPanel() {
    const hint = element('p', '', PROMPTS[this.kind]);
    this.inputs = FIELDS[this.kind].map(([name, title, words, first]) => {
      const input = element('input');
      [input.name, input.type, input.step, input.min, input.value] = [name, 'number', 'any', '0', first];
      if (name === 'radius') input.value = number(0.05 * Math.max(...this.page.log.bounds.slice(0, 2).map(([low, high]) => high - low)));
      input.oninput = () => this.changed();
      const label = element('label', '', `${title} `);
      label.title = words;
      label.append(input);
      return [input, label];
    });
    const { origin } = this.page.log.scene;
    this.typed = element('input');
    this.typed.name = 'corners';
    this.typed.oninput = () => {
      this.corners = fromText(this.typed.value, origin) || [];
      this.changed();
    };
    const written = element('label', '', `${origin ? 'latitude, longitude' : 'x, y [m]'}${this.kind === 'searched' ? '; ...' : ''} `);
    written.append(this.typed);
    this.undo = button('Undo', () => this.place(this.corners.slice(0, -1)));
    this.sender = button('Send', () => this.sendPlaced(), { report: 'send' });
    const cancel = button('Cancel', () => this.start(null));
    this.status = element('span', 'quiet', '');
    this.panel.replaceChildren(hint, written, ...this.inputs.map(([, label]) => label), this.sender, this.undo, cancel, this.status);
  }

  // Add a corner, or move the position, to a point of the canvas.
  click(x, y) {
    const { camera, map } = this.page;
    const corner = camera.ground(x, y, map.floor).slice(0, 2).map((value) => Number(value.toFixed(3)));
    this.place(this.kind === 'sighting' ? [corner] : [...this.corners, corner]);
  }

  // Set the corners, and the field in which they can be typed.
  place(corners) {
    this.corners = corners;
    this.typed.value = asText(corners, this.page.log.scene.origin);
    this.changed();
  }

  // Return what the statement lacks, or an empty text.
  problem() {
    const empty = this.inputs.find(([input]) => !(Number(input.value) > 0));
    if (this.typed.value.trim() && !this.corners.length) return 'allowed are two numbers, of corners in rows with ;';
    if (this.kind === 'sighting' && this.corners.length !== 1) return 'allowed is one position';
    const ring = this.kind === 'searched' ? problemOf(this.corners) : '';
    return ring || (empty ? `${empty[0].name.replace('_', ' ')}: allowed are numbers above 0` : '');
  }

  async sendPlaced() {
    const fields = Object.fromEntries(this.inputs.map(([input]) => [input.name, Number(input.value)]));
    const ring = [...this.corners, this.corners[0]].map((corner) => corner.join(' '));
    const done = this.kind === 'sighting'
      ? await this.send({ report: 'add_sighting', position: this.corners[0], ...fields })
      : await this.send({ report: 'mark_searched', zone: `POLYGON ((${ring.join(', ')}))`, ...fields });
    if (done && this.kind) this.start(null);
  }

  // Send a statement; return whether it was accepted.
  async send(body) {
    const answer = document.querySelector('#controls [role=status]');
    answer.textContent = 'sending ...';
    try {
      const { done, message } = await send('report', { ...body, source: this.person.value.trim() });
      answer.textContent = `${done ? '' : 'Refused: '}${message}`;
      return done;
    } catch {
      answer.textContent = 'statement: no answer';
      return false;
    }
  }

  draw({ canvas, context, camera, floor }) {
    if (!this.kind) return;
    canvas.style.cursor = 'crosshair';
    context.lineWidth = 2.5;
    context.strokeStyle = this.kind === 'sighting' ? SIGHTED : VISITED;
    const places = this.corners.map(([x, y]) => [x, y, floor]);
    if (this.kind === 'sighting' && places.length) path(context, camera, circle(places[0], Math.max(0, Number(this.inputs[0][0].value) || 0)), true);
    else path(context, camera, places, true);
    context.stroke();
    for (const place of places) {
      const [x, y] = camera.project(place);
      context.strokeRect(x - 3.5, y - 3.5, 7, 7);
    }
    context.lineWidth = 1;
  }

  // Show the found targets, with buttons if persons can state something.
  showFinds(log, time) {
    const finds = log.isOfBuildings ? [] : log.owners('found').flatMap((space) => findsOf(log, space, time));
    this.section.hidden = !(finds.length || this.enabled);
    const body = this.section.querySelector('tbody');
    const size = log.isSpatial ? 3 : 2;
    const shown = finds.map((find) => [find.space, find.id, find.place.slice(0, size).map((value) => number(value)).join(', '), stateOfFind(find), find.counts, find.picture]);
    // New rows lose the keyboard focus.
    const key = JSON.stringify([shown, this.enabled]);
    if (body.dataset.key === key) return;
    body.dataset.key = key;
    body.replaceChildren(...shown.map(([space, id, place, state, counts, picture]) => {
      const row = element('tr', counts ? '' : 'quiet');
      row.dataset.target = id;
      const buttons = element('td', '');
      if (this.enabled) {
        for (const [title, confirmed] of [['Confirm', true], ['Reject', false]]) {
          const review = () => this.send({ report: 'review_target', team: space, id, confirmed, reliability: 0 });
          buttons.append(button(title, review, { confirmed }), ' ');
        }
      }
      const where = element('td', 'text', `(${place}) m`);
      where.append(element('br'), element('span', 'quiet', state));
      const seen = element('td', '');
      if (picture) {
        const image = element('img');
        image.src = `data:image/jpeg;base64,${picture}`;
        image.alt = `Target ${id} in the image of a camera`;
        seen.append(image);
      }
      row.append(seen, element('td', '', space ? `${space} ${id}` : String(id)), where, buttons);
      return row;
    }));
  }
}
