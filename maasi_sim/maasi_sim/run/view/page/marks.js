// Marks above the time line: finds, and robots that left or failed.

import { FOUND, themed } from './colours.js';
import { prepared } from './shapes.js';

// Offset of the input's track from the centre of its knob at the left [px].
export const KNOB = 8;

export function drawMarks(canvas, log) {
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  const key = [width, window.devicePixelRatio, log.scene.name, log.size, document.documentElement.dataset.theme].join(' ');
  if (canvas.dataset.key === key) return;
  canvas.dataset.key = key;
  const context = prepared(canvas, width, height);
  for (const [time, , , level, , text] of log.lines.events) {
    const x = KNOB + ((width - 2 * KNOB) * time) / (log.duration || 1);
    if (level === 'found') {
      context.fillStyle = FOUND;
      context.fillRect(x - 1, 0, 2.5, height);
    } else if (level === 'fault' || (level === 'team' && text === 'left')) {
      context.fillStyle = themed('--fault');
      context.beginPath();
      context.moveTo(x - 4, 0);
      context.lineTo(x + 4, 0);
      context.lineTo(x, height);
      context.fill();
    }
  }
}
