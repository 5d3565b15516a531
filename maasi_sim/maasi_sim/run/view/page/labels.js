// Texts on the map that do not cover each other.

import { themed } from './colours.js';

// Offsets of a text from its point, in the order in which they are tried.
const PLACES = [[1, -1], [1, 1], [-1, -1], [-1, 1], [1, 0], [-1, 0], [0, -1], [0, 1]];
const HEIGHT = 13;

export class Labels {
  constructor() {
    this.wanted = [];
  }

  // Add a text near a point; needed ones are always drawn, before others.
  add(text, x, y, { font = '11px system-ui, sans-serif', away = 6, needed = false } = {}) {
    this.wanted.push({ text, x, y, font, away, needed });
  }

  draw(context, width, height) {
    const around = (x, y, half) => ({ left: x - half, right: x + half, top: y - half, bottom: y + half });
    const taken = this.wanted.map(({ x, y }) => around(x, y, 3));
    const isFree = (box) => box.left >= 0 && box.right <= width && box.top >= 0 && box.bottom <= height
      && taken.every((other) => box.right <= other.left || box.left >= other.right || box.bottom <= other.top || box.top >= other.bottom);
    this.wanted.sort((a, b) => b.needed - a.needed);
    for (const { text, x, y, font, away, needed } of this.wanted) {
      context.font = font;
      const wide = context.measureText(text).width;
      const boxes = PLACES.map(([right, down]) => {
        const [middleX, middleY] = [x + right * (away + wide / 2), y + down * (away + HEIGHT / 2 - (right ? 5 : 0))];
        return { left: middleX - wide / 2, right: middleX + wide / 2, top: middleY - HEIGHT / 2, bottom: middleY + HEIGHT / 2 };
      });
      const box = boxes.find(isFree) || (needed && boxes[0]);
      if (!box) continue;
      taken.push(box);
      context.lineWidth = 3;
      context.lineJoin = 'round';
      context.strokeStyle = themed('--back');
      context.strokeText(text, box.left, box.bottom - 3);
      context.fillStyle = themed('--text');
      context.fillText(text, box.left, box.bottom - 3);
    }
    context.lineWidth = 1;
  }
}
