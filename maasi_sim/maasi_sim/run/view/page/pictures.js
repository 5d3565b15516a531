// What the cameras saw when their robots last measured, with the detections in it.

import { SEEN, robotColour } from './colours.js';
import { element } from './text.js';

const SVG = 'http://www.w3.org/2000/svg';

function part(name, attributes) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

// Circles around detections.
function circles([width, height], marks) {
  const over = part('svg', { viewBox: `0 0 ${width} ${height}`, 'aria-hidden': 'true' });
  for (const [x, y, radius] of marks) {
    const style = { fill: 'none', stroke: SEEN, 'stroke-width': width / 80 };
    over.append(part('circle', { cx: x, cy: y, r: 1.4 * radius + width / 80, ...style }));
  }
  return over;
}

function make(log, name) {
  const figure = element('figure');
  figure.dataset.robot = name;
  const caption = element('figcaption');
  const swatch = element('span', 'swatch');
  swatch.style.background = robotColour(log.robots(), name);
  caption.append(swatch, element('b', '', name), ' ', element('span', 'age'));
  figure.append(element('div', 'image'), caption);
  return figure;
}

export function showPictures(section, log, time, onSelect) {
  const names = log.owners('picture');
  section.hidden = names.length === 0;
  const list = section.querySelector('div');
  const key = `${log.scene.name} ${names} ${document.documentElement.dataset.theme}`;
  if (list.dataset.key !== key) {
    list.dataset.key = key;
    list.replaceChildren(...names.map((name) => make(log, name)));
    for (const figure of list.children) figure.onclick = () => onSelect(figure.dataset.robot);
  }
  for (const figure of list.children) show(figure, log.at('picture', figure.dataset.robot, time), time);
}

function show(figure, event, time) {
  const { length } = event ? event[5] : [];
  const count = `${length} detection${length === 1 ? '' : 's'}`;
  const seconds = event && Math.floor(time - event[0]);
  const age = seconds < 1 ? 'now' : `${seconds} s ago`;
  const words = event ? `${age}, ${count}` : 'no picture yet';
  const shown = figure.querySelector('.age');
  if (shown.textContent !== words) shown.textContent = words;
  const at = event ? String(event[0]) : '';
  if (figure.dataset.at === at) return;
  figure.dataset.at = at;
  const frame = figure.querySelector('.image');
  frame.replaceChildren();
  if (!event) return;
  const [when, , robot, data, size, marks] = event;
  const image = element('img');
  [image.width, image.height] = size;
  image.src = `data:image/jpeg;base64,${data}`;
  image.alt = `Camera of ${robot} at ${when.toFixed(1)} s: ${count}`;
  frame.append(image, circles(size, marks));
}
