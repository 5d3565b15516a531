// The curves of finds and of the expected number left over time.

import { FOUND, POTENTIAL, themed } from './colours.js';
import { prepared } from './shapes.js';

export class Curve {
  constructor(canvas) {
    this.canvas = canvas;
    this.picture = document.createElement('canvas');
    this.key = '';
  }

  // Begin and length of the time axis [px].
  get axis() {
    return [28, this.canvas.clientWidth - 36];
  }

  draw(log, time) {
    const { canvas, picture } = this;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    const key = [width, height, ratio, log.scene.name, log.size, document.documentElement.dataset.theme].join(' ');
    if (key !== this.key) {
      [canvas.width, canvas.height] = [width * ratio, height * ratio];
      this.plot(log, prepared(picture, width, height), width, height);
      this.key = key;
    }
    const context = canvas.getContext('2d');
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, canvas.width, canvas.height);
    context.drawImage(picture, 0, 0);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    const [left, wide] = this.axis;
    const x = left + (wide * time) / (log.duration || 1);
    context.strokeStyle = themed('--accent');
    context.beginPath();
    context.moveTo(x, 4);
    context.lineTo(x, height - 18);
    context.stroke();
  }

  plot(log, context, width, height) {
    const found = log.isOfBuildings
      ? { times: log.visits.times, events: log.visits.times.map((_, index) => index + 1) }
      : log.totals;
    // Without an expected number only potential targets are known.
    const [other, title] = log.knowsExpected ? [log.left, 'expected left'] : [log.potential, 'potential'];
    const most = Math.max(1, log.total || 0, ...found.events.slice(-1), ...sampled(other, 500).map((item) => item[1]));
    const [left, wide] = this.axis;
    const top = 6;
    const high = height - 26;
    const x = (time) => left + (wide * time) / (log.duration || 1);
    const y = (value) => top + high * (1 - value / most);
    context.strokeStyle = themed('--line');
    context.strokeRect(left, top, wide, high);
    context.fillStyle = themed('--quiet');
    context.font = '10px system-ui, sans-serif';
    context.textAlign = 'right';
    context.fillText(String(Math.round(most)), left - 3, top + 8);
    context.fillText('0', left - 3, top + high);
    context.fillText(`${log.duration.toFixed(0)} s`, left + wide, height - 6);
    context.textAlign = 'left';
    // A line sample, then its name: orange letters on white are illegible.
    const entry = (colour, dash, text, from) => {
      context.strokeStyle = colour;
      context.lineWidth = 2;
      context.setLineDash(dash);
      context.beginPath();
      context.moveTo(from, height - 9);
      context.lineTo(from + 16, height - 9);
      context.stroke();
      context.setLineDash([]);
      context.fillText(text, from + 20, height - 6);
    };
    context.fillStyle = themed('--text');
    entry(FOUND, [], log.isOfBuildings ? 'visited' : 'found', left);
    if (other.times.length) entry(POTENTIAL, [4, 3], title, left + 66);
    const steps = (points, colour, dash) => {
      context.strokeStyle = colour;
      context.setLineDash(dash);
      context.lineWidth = 1.8;
      context.beginPath();
      let value = 0;
      context.moveTo(x(0), y(0));
      for (const [time, next] of points) {
        context.lineTo(x(time), y(value));
        context.lineTo(x(time), y(next));
        value = next;
      }
      context.lineTo(x(log.duration), y(value));
      context.stroke();
      context.setLineDash([]);
      context.lineWidth = 1;
    };
    if (other.times.length) steps(sampled(other, 800), POTENTIAL, [4, 3]);
    steps(sampled(found, 2000), FOUND, []);
  }
}

// Return at most `most` pairs of time and value, including the last one.
function sampled({ times, events }, most) {
  const stride = Math.max(1, Math.ceil(times.length / most));
  const points = [];
  for (let index = 0; index < times.length; index += stride) points.push([times[index], events[index]]);
  if (times.length) points.push([times[times.length - 1], events[events.length - 1]]);
  return points;
}
