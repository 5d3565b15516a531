// Icons as outlines, as fonts may lack them or show emoji.

export const SVG = 'http://www.w3.org/2000/svg';
// Outlines of 16 by 16; lines are not filled.
const OUTLINES = {
  play: 'M4 2 L14 8 L4 14 Z',
  pause: 'M3 2 H7 V14 H3 Z M9 2 H13 V14 H9 Z',
  previous: 'M8 2 L2 8 L8 14 Z M15 2 L9 8 L15 14 Z',
  next: 'M1 2 L7 8 L1 14 Z M8 2 L14 8 L8 14 Z',
  found: 'M8 3 A5 5 0 1 1 7.99 3 Z',
  decision: 'M1 7 H9 V3 L15 8 L9 13 V9 H1 Z',
  team: 'M8 2 L14 8 L8 14 L2 8 Z M8 5 L5 8 L8 11 L11 8 Z',
  warning: 'M8 1 L15 15 H1 Z M7.2 6 V10.5 H8.8 V6 Z M7.2 11.5 V13 H8.8 V11.5 Z',
  fault: 'M3 1 L8 6 L13 1 L15 3 L10 8 L15 13 L13 15 L8 10 L3 15 L1 13 L6 8 L1 3 Z',
  cross: 'M3.5 2 L8 6.5 L12.5 2 L14 3.5 L9.5 8 L14 12.5 L12.5 14 L8 9.5 L3.5 14 L2 12.5 L6.5 8 L2 3.5 Z',
  down: 'M2 5 H14 L8 12 Z',
  tick: 'M7 1 H9 V15 H7 Z',
  rover: 'M15 8 L2 14 L5 8 L2 2 Z',
  multirotor: 'M4 1.5 A2.6 2.6 0 1 1 3.99 1.5 Z M4 9.3 A2.6 2.6 0 1 1 3.99 9.3 Z M12 1.5 A2.6 2.6 0 1 1 11.99 1.5 Z M12 9.3 A2.6 2.6 0 1 1 11.99 9.3 Z M6 6 H10 L13 8 L10 10 H6 Z',
};

export function icon(name) {
  const drawn = document.createElementNS(SVG, 'svg');
  const outline = document.createElementNS(SVG, 'path');
  drawn.setAttribute('viewBox', '0 0 16 16');
  drawn.setAttribute('class', 'icon');
  drawn.setAttribute('aria-hidden', 'true');
  outline.setAttribute('d', OUTLINES[name]);
  outline.setAttribute('fill-rule', 'evenodd');
  drawn.append(outline);
  return drawn;
}
