// Background picture, north arrow and scale bar.

import { themed } from './colours.js';

// Tiles per side of a picture in perspective.
const TILES = 12;
// Longest scale bar [px].
const LONGEST = 130;

export class Background {
  // The picture loads asynchronously; then `onReady` is called.
  constructor(onReady) {
    this.onReady = onReady;
    this.given = null;
  }

  draw({ context, camera, floor }, { background }) {
    if (!background) return;
    if (this.given !== background) {
      this.given = background;
      this.image = new Image();
      this.image.onload = this.onReady;
      this.image.src = `data:image/webp;base64,${background[0]}`;
    }
    const { image } = this;
    if (!image.complete || !image.naturalWidth) return;
    const [[left, right], [low, high]] = background[1];
    const at = (across, down) => camera.project([left + across * (right - left), high - down * (high - low), floor]);
    const count = camera.spatial ? TILES : 1;
    const [wide, tall] = [image.naturalWidth / count, image.naturalHeight / count];
    context.imageSmoothingEnabled = true;
    for (let i = 0; i < count; i += 1) {
      for (let j = 0; j < count; j += 1) {
        const [[x, y], [ax, ay], [bx, by]] = [at(i / count, j / count), at((i + 1) / count, j / count), at(i / count, (j + 1) / count)];
        context.save();
        context.transform((ax - x) / wide, (ay - y) / wide, (bx - x) / tall, (by - y) / tall, x, y);
        // Half a pixel wider, to avoid gaps.
        const more = camera.spatial ? 0.5 : 0;
        context.drawImage(image, i * wide, j * tall, wide, tall, 0, 0, wide + more, tall + more);
        context.restore();
      }
    }
  }
}

// North is +y of the map.
export function drawNorth({ context, camera, floor }, bounds) {
  const middle = [0, 1].map((axis) => (bounds[axis][0] + bounds[axis][1]) / 2);
  const [x, y] = camera.project([...middle, floor]);
  const [nx, ny] = camera.project([middle[0], middle[1] + 1 / camera.scale, floor]);
  const size = Math.hypot(nx - x, ny - y) || 1;
  const [ux, uy] = [(nx - x) / size, (ny - y) / size];
  context.save();
  context.translate(camera.width - 36, 40);
  context.transform(-uy, ux, -ux, -uy, 0, 0);
  context.fillStyle = themed('--text');
  context.strokeStyle = themed('--back');
  context.lineWidth = 2;
  const arrow = new Path2D('M0 -16 L7 10 L0 5 L-7 10 Z');
  context.stroke(arrow);
  context.fill(arrow);
  context.restore();
  write(context, 'N', camera.width - 36 + 24 * ux, 44 + 24 * uy, 'center');
}

export function drawScale({ context, camera }, step) {
  const [right, bottom] = [camera.width - 12, camera.height - 8];
  if (camera.spatial) {
    write(context, `grid ${lengthWords(step)}`, right, bottom, 'right');
    return;
  }
  const power = 10 ** Math.floor(Math.log10(LONGEST / camera.scale));
  const length = power * [5, 2, 1].find((factor) => factor * power * camera.scale <= LONGEST);
  const left = right - length * camera.scale;
  for (const [colour, width] of [['--back', 5], ['--text', 2]]) {
    context.strokeStyle = themed(colour);
    context.lineWidth = width;
    context.beginPath();
    context.moveTo(left, bottom - 6);
    context.lineTo(left, bottom);
    context.lineTo(right, bottom);
    context.lineTo(right, bottom - 6);
    context.stroke();
  }
  context.lineWidth = 1;
  write(context, `${lengthWords(length)}, grid ${lengthWords(step)}`, right, bottom - 10, 'right');
}

function lengthWords(length) {
  const [value, unit] = length >= 1000 ? [length / 1000, 'km'] : [length, 'm'];
  return `${Number(value.toPrecision(2))} ${unit}`;
}

// Letters that are legible on any picture.
function write(context, text, x, y, align) {
  context.font = '600 11px system-ui, sans-serif';
  context.textAlign = align;
  context.lineWidth = 3;
  context.strokeStyle = themed('--back');
  context.strokeText(text, x, y);
  context.fillStyle = themed('--text');
  context.fillText(text, x, y);
  context.textAlign = 'left';
  context.lineWidth = 1;
}
