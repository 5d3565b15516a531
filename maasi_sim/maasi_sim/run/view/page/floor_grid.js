// A grid of coloured floor cells, from above as an image, else cell by cell.

import { themed } from './colours.js';

export class FloorGrid {
  // `shade`: red, green, blue and opacity (to 255) of a share of `most`, from colours of the theme.
  constructor(most, names, shade, isSmooth = false) {
    Object.assign(this, { most, names, shade, isSmooth });
    this.canvas = document.createElement('canvas');
  }

  // Return the colour of each level.
  get colours() {
    const themes = this.names.map(themed);
    if (this.themes !== themes.join()) {
      const given = themes.map((theme) => theme.split(',').map(Number));
      this.shades = Array.from({ length: this.most + 1 }, (_, level) => this.shade(level / this.most, ...given).map(Math.round));
      this.themes = themes.join();
    }
    return this.shades;
  }

  // Draw levels (nx, ny), up to `most`.
  draw({ context, camera, floor }, { corner, step, shape }, levels) {
    const [nx, ny] = shape;
    const { colours } = this;
    const [left, low] = [0, 1].map((axis) => corner[axis] - step[axis] / 2);
    if (camera.spatial) {
      const paths = [];
      for (let i = 0; i < nx; i += 1) {
        for (let j = 0; j < ny; j += 1) {
          const level = levels[i * ny + j];
          if (!level) continue;
          paths[level] = paths[level] || new Path2D();
          [[0, 0], [1, 0], [1, 1], [0, 1]].forEach(([right, up], index) => {
            const [x, y] = camera.project([left + (i + right) * step[0], low + (j + up) * step[1], floor]);
            if (index) paths[level].lineTo(x, y);
            else paths[level].moveTo(x, y);
          });
          paths[level].closePath();
        }
      }
      paths.forEach((cells, level) => {
        const [red, green, blue, opacity] = colours[level];
        context.fillStyle = `rgba(${red}, ${green}, ${blue}, ${opacity / 255})`;
        context.fill(cells);
      });
      return;
    }
    if (this.levels !== levels || this.drawn !== colours) {
      Object.assign(this, { levels, drawn: colours });
      [this.canvas.width, this.canvas.height] = [nx, ny];
      const pixels = new ImageData(nx, ny);
      for (let i = 0; i < nx; i += 1) {
        for (let j = 0; j < ny; j += 1) {
          if (levels[i * ny + j]) pixels.data.set(colours[levels[i * ny + j]], 4 * ((ny - 1 - j) * nx + i));
        }
      }
      this.canvas.getContext('2d').putImageData(pixels, 0, 0);
    }
    const [x, y] = camera.project([left, low + ny * step[1]]);
    context.imageSmoothingEnabled = this.isSmooth;
    context.drawImage(this.canvas, x, y, nx * step[0] * camera.scale, ny * step[1] * camera.scale);
  }
}
