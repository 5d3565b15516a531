// A grid of coloured floor cells, from above as an image, else cell by cell.

export class FloorGrid {
  constructor(isSmooth = false) {
    this.isSmooth = isSmooth;
    this.canvas = document.createElement('canvas');
  }

  // Draw levels (nx, ny); `colours`: red, green, blue and opacity (to 255) of each level.
  draw({ context, camera, floor }, { corner, step, shape }, levels, colours) {
    const [nx, ny] = shape;
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
    if (this.levels !== levels || this.colours !== colours) {
      Object.assign(this, { levels, colours });
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
