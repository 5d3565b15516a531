// Camera pictures of the last measurements, with their detections.

import { SEEN, robotColour } from './colours.js';
import { SVG } from './icons.js';
import { element } from './text.js';

// A circle around a detection in an image.
function detectionMark([width, height], [column, row, radius]) {
  const mark = element('i');
  const half = 1.4 * radius + width / 80;
  mark.style.left = `${(100 * (column - half)) / width}%`;
  mark.style.top = `${(100 * (row - half)) / height}%`;
  mark.style.width = `${(200 * half) / width}%`;
  mark.style.borderColor = SEEN;
  return mark;
}

// The area of the sensor model is outlined; the rest is dimmed.
function outlineOf([width, height], corners) {
  if (!corners.length) return [];
  const ring = `M${corners.map((corner) => corner.join(' ')).join(' L')} Z`;
  const [drawn, rest, edge] = ['svg', 'path', 'path'].map((name) => document.createElementNS(SVG, name));
  drawn.setAttribute('viewBox', `0 0 ${width} ${height}`);
  rest.setAttribute('d', `M0 0 H${width} V${height} H0 Z ${ring}`);
  rest.setAttribute('class', 'rest');
  edge.setAttribute('d', ring);
  edge.setAttribute('class', 'edge');
  drawn.append(rest, edge);
  return [drawn];
}

function pictureFrame(log, name) {
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
  section.querySelector('p').hidden = !names.some((name) => (log.at('picture', name, time) || [])[6]?.length);
  const list = section.querySelector('div');
  const key = `${log.scene.name} ${names} ${document.documentElement.dataset.theme}`;
  if (list.dataset.key !== key) {
    list.dataset.key = key;
    list.replaceChildren(...names.map((name) => pictureFrame(log, name)));
    for (const figure of list.children) figure.onclick = () => onSelect(figure.dataset.robot);
  }
  for (const figure of list.children) fillPicture(figure, log.at('picture', figure.dataset.robot, time), time);
}

function fillPicture(figure, event, time) {
  const marks = event && event[5];
  const count = marks ? `, ${marks.length} detection${marks.length === 1 ? '' : 's'}` : '';
  const seconds = event && Math.floor(time - event[0]);
  const age = seconds < 1 ? 'now' : `${seconds} s ago`;
  const words = event ? age + count : 'no picture yet';
  const shown = figure.querySelector('.age');
  if (shown.textContent !== words) shown.textContent = words;
  const at = event ? String(event[0]) : '';
  if (figure.dataset.at === at) return;
  figure.dataset.at = at;
  const frame = figure.querySelector('.image');
  frame.replaceChildren();
  if (!event) return;
  const [when, , robot, data, size, , outline = []] = event;
  const image = element('img');
  [image.width, image.height] = size;
  image.src = `data:image/jpeg;base64,${data}`;
  image.alt = `Camera of ${robot} at ${when.toFixed(1)} s${count}`;
  frame.append(image, ...outlineOf(size, outline), ...(marks || []).map((mark) => detectionMark(size, mark)));
}
