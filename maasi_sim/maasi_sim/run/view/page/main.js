// The page: shown time, layers, and input of the user.

import { Camera } from './camera.js';
import { Curve } from './curve.js';
import { Drawing } from './drawing.js';
import { follow, showControls, updateControls } from './live.js';
import { icon } from './icons.js';
import { MapView } from './map.js';
import { showLegend } from './legend.js';
import { drawMarks } from './marks.js';
import { showLog, showNumbers, showRobots } from './panels.js';
import { showPictures } from './pictures.js';
import { Reports } from './reports.js';
import { RunLog, unpack } from './run_log.js';
import { button } from './text.js';
import { showStrips } from './strips.js';
import { showTip, tipAt } from './tips.js';
import { showWhy } from './why.js';
import { hasEnded, headline, showCard, showHeadline } from './words.js';

const $ = (id) => document.getElementById(id);
// Frames per second of a live run, low to leave the processor to the search.
const LIVE_RATE = 3;
const reducedMotion = window.matchMedia('(prefers-reduced-motion: reduce)');

class Page {
  constructor() {
    this.log = new RunLog({ name: '' });
    this.time = 0;
    this.playing = false;
    this.following = false;
    this.isLive = false;
    this.connection = '';
    this.selected = null;
    this.marked = null;
    this.drawn = 0;
    this.camera = new Camera();
    this.map = new MapView($('map'), this.camera, () => this.request());
    this.curve = new Curve($('curve'));
    this.drawing = new Drawing($('tools'), $('drawing'), this);
    this.reports = new Reports($('tools'), $('report'), $('finds'), this);
    this.fitted = false;
  }

  start() {
    const dark = window.matchMedia('(prefers-color-scheme: dark)').matches;
    document.documentElement.dataset.theme = dark ? 'dark' : 'light';
    this.listen();
    this.addLayers();
    const inside = $('run').textContent.trim();
    if (inside) {
      unpack(inside).then((log) => {
        this.setLog(log);
        this.seek(0);
        document.body.dataset.ready = 'yes';
        this.playByItself();
      }).catch((error) => {
        $('source').textContent = `cannot read the run in this file: ${error.message}`;
      });
    } else this.followRun();
  }

  // Play a replay when it becomes visible, unless the user has already interacted.
  playByItself() {
    if (reducedMotion.matches || this.time > 0) return;
    if (document.visibilityState === 'visible') this.setPlaying(true);
    else document.addEventListener('visibilitychange', () => this.playByItself(), { once: true });
  }

  followRun() {
    this.isLive = true;
    this.connection = 'live';
    $('live').hidden = false;
    this.setFollowing(true);
    follow(
      (log) => this.setLog(log),
      (events) => {
        for (const event of events) this.log.add(event);
        if (events.some((event) => event[1] === 'scene')) this.setLog(this.log);
        this.changed = true;
        document.body.dataset.ready = 'yes';
      },
      (state) => {
        $('source').textContent = state;
        document.body.dataset.connection = state;
        this.connection = state;
        this.request();
        if (state !== 'ended') return;
        // The run has ended: from now on this is a replay.
        if (this.following) this.time = this.log.duration;
        this.setFollowing(false);
        this.isLive = false;
        for (const id of ['controls', 'live']) $(id).hidden = true;
        this.reports.enable(false);
      },
    );
  }

  setLog(log) {
    this.log = log;
    $('title').textContent = `MAASI ${log.scene.name || ''}`;
    document.title = `MAASI ${log.scene.name || ''}`;
    const { seed, planner } = log.scene;
    if (!this.isLive) {
      const facts = [seed === undefined ? '' : `seed ${seed}`, planner ? `planner ${planner}` : ''];
      facts.push(log.scene.missing || '', `replay, ${log.size} events`, log.scene.thinned ? `reduced to one state per ${log.scene.thinned} s` : '');
      $('source').textContent = facts.filter(Boolean).join(', ');
    }
    if (log.scene.control && !$('controls').childElementCount) showControls($('controls'), () => this.selected);
    this.reports.enable(Boolean(this.isLive && log.scene.control && !log.isOfBuildings));
    for (const button of $('layers').querySelectorAll('[data-layer]')) {
      const { layer } = button.dataset;
      button.hidden = layer === 'background' ? !log.scene.background : log.isOfBuildings && layer !== 'ways';
    }
    $('tools').hidden = log.isOfBuildings;
    $('curve_title').textContent = log.isOfBuildings ? 'Cuboids visited' : `Found and ${log.knowsExpected ? 'expected' : 'potential'}`;
    this.fitted = false;
    this.changed = true;
    this.cardClosed = false;
    this.request();
  }

  addLayers() {
    const layers = [['background', 'Background'], ['truth', 'Truth'], ['unseen', 'Explored'], ['left', 'Undetected targets'], ['belief', 'Potential per area'], ['view', 'Field of view'], ['ways', 'Paths'], ['clusters', 'Potential'], ['detections', 'Detections']];
    for (const [name, title] of layers) {
      const layer = button(title, () => {
        this.map.layers[name] = !this.map.layers[name];
        layer.setAttribute('aria-pressed', String(this.map.layers[name]));
        this.request();
      }, { layer: name });
      layer.setAttribute('aria-pressed', String(this.map.layers[name]));
      $('layers').append(layer);
    }
    const space = button('3D', () => this.setSpatial(!this.camera.spatial));
    space.id = 'space';
    $('layers').append(space, button('Fit', () => this.fit()));
  }

  setSpatial(spatial) {
    this.camera.spatial = spatial;
    $('space').setAttribute('aria-pressed', String(spatial));
    this.fit();
  }

  fit() {
    this.camera.fit(this.log.bounds);
    this.fitted = true;
    this.request();
  }

  listen() {
    for (const id of ['previous', 'play', 'next']) $(id).append(icon(id));
    $('play').onclick = () => this.setPlaying(!this.playing);
    $('previous').onclick = () => this.step(-1);
    $('next').onclick = () => this.step(1);
    $('live').onclick = () => this.setFollowing(true);
    $('time').oninput = () => this.seek(Number($('time').value));
    $('theme').onclick = () => {
      const root = document.documentElement;
      root.dataset.theme = root.dataset.theme === 'dark' ? 'light' : 'dark';
      this.request();
    };
    $('curve').onclick = (event) => {
      const [left, wide] = this.curve.axis;
      this.seek((this.log.duration * (event.offsetX - left)) / wide);
    };
    window.addEventListener('resize', () => {
      this.fitted = false;
      this.request();
    });
    window.addEventListener('keydown', (event) => this.press(event));
    this.listenToPointers();
  }

  press(event) {
    const tag = event.target.tagName;
    if (event.ctrlKey || event.metaKey || event.altKey || tag === 'SELECT' || (tag === 'INPUT' && event.target.type !== 'range')) return;
    const step = event.shiftKey ? 10 : 1;
    const actions = {
      ' ': () => this.setPlaying(!this.playing),
      ArrowLeft: () => this.seek(this.time - step),
      ArrowRight: () => this.seek(this.time + step),
      ArrowUp: () => this.step(1),
      ArrowDown: () => this.step(-1),
      Home: () => this.seek(0),
      End: () => this.seek(this.log.duration),
      Escape: () => {
        if (this.tool) this.tool.start(null);
        else this.select(null);
      },
    };
    const action = actions[event.key];
    if (!action || (event.key === ' ' && tag === 'BUTTON')) return;
    event.preventDefault();
    action();
  }

  listenToPointers() {
    const canvas = $('map');
    const held = new Map();
    let moved = 0;
    canvas.addEventListener('pointerdown', (event) => {
      canvas.setPointerCapture(event.pointerId);
      held.set(event.pointerId, [event.offsetX, event.offsetY]);
      moved = held.size > 1 ? 100 : 0;
    });
    canvas.addEventListener('pointermove', (event) => {
      const before = held.get(event.pointerId);
      if (!before) {
        this.point(event.offsetX, event.offsetY);
        return;
      }
      showTip($('tip'), '');
      const now = [event.offsetX, event.offsetY];
      moved += Math.hypot(now[0] - before[0], now[1] - before[1]);
      if (held.size === 2) {
        const other = [...held.entries()].find(([id]) => id !== event.pointerId)[1];
        const spread = (point) => Math.hypot(point[0] - other[0], point[1] - other[1]) || 1;
        this.camera.zoom(spread(now) / spread(before), other[0], other[1]);
      } else this.camera.drag(now[0] - before[0], now[1] - before[1]);
      held.set(event.pointerId, now);
      this.request();
    });
    const release = (event) => {
      if (held.delete(event.pointerId) && event.type === 'pointerup' && moved < 5) {
        this.choose(event.offsetX, event.offsetY);
      }
    };
    canvas.addEventListener('pointerup', release);
    canvas.addEventListener('pointercancel', release);
    // On touch screens the tip stays after the finger is lifted.
    canvas.addEventListener('pointerleave', (event) => event.pointerType === 'mouse' && showTip($('tip'), ''));
    canvas.addEventListener('wheel', (event) => {
      event.preventDefault();
      this.camera.zoom(Math.exp(-0.0015 * event.deltaY), event.offsetX, event.offsetY);
      this.request();
    }, { passive: false });
  }

  // What clicks on the map draw, if anything.
  get tool() {
    return [this.reports, this.drawing].find(({ kind }) => kind);
  }

  choose(x, y) {
    if (this.tool) {
      this.tool.click(x, y);
      return;
    }
    const hit = this.map.hit(x, y);
    if (!hit) this.select(null);
    else if (hit.robot) this.select(hit.robot);
    else if (hit.candidate !== undefined) this.mark(hit.candidate);
    this.point(x, y);
  }

  // Show the tip for a point of the map.
  point(x, y) {
    showTip($('tip'), tipAt(this.map, this.log, this.time, this.selected, x, y), x, y);
  }

  select(name) {
    this.selected = name;
    this.marked = null;
    this.request();
  }

  mark(candidate) {
    this.marked = candidate;
    delete $('why_body').dataset.key;
    this.request();
  }

  // Go to the next or previous time at which a decision was made.
  step(direction) {
    const { times, events } = this.log.decisions;
    const count = this.log.decisions.count(this.time + (direction > 0 ? 1e-9 : -1e-9));
    const index = direction > 0 ? count : count - 1;
    if (index < 0 || index >= times.length) return;
    if (!this.selected || events[index].name !== this.selected) this.select(events[index].name);
    this.seek(times[index]);
  }

  seek(time) {
    this.time = Math.min(Math.max(Number.isFinite(time) ? time : 0, 0), this.log.duration);
    if (this.isLive) this.setFollowing(false);
    this.request();
  }

  setPlaying(playing) {
    if (playing && this.time >= this.log.duration) this.time = 0;
    if (playing && this.following) this.setFollowing(false);
    this.playing = playing;
    $('play').replaceChildren(icon(playing ? 'pause' : 'play'));
    $('play').setAttribute('aria-label', playing ? 'Pause' : 'Play');
    this.request();
  }

  setFollowing(following) {
    this.following = following;
    $('live').setAttribute('aria-pressed', String(following));
    if (following) this.setPlaying(false);
    this.request();
  }

  request() {
    if (this.requested) return;
    this.requested = true;
    requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    this.requested = false;
    const passed = this.last === undefined ? 0 : Math.min(now - this.last, 200);
    this.last = this.playing ? now : undefined;
    if (this.playing) {
      this.time += (passed / 1000) * Number($('speed').value);
      if (this.time >= this.log.duration) {
        this.time = this.log.duration;
        if (!this.isLive) this.setPlaying(false);
      }
    }
    if (this.following) this.time = this.log.duration;
    this.draw();
    if (this.playing) this.request();
  }

  // The headline, the card at the end, and enabled buttons.
  tell() {
    const { log, time } = this;
    const wait = showHeadline($('headline'), headline(log, time, this.connection), performance.now());
    if (wait > 0 && !this.waiting) {
      this.waiting = setTimeout(() => {
        this.waiting = undefined;
        this.request();
      }, wait);
    }
    const shown = hasEnded(log, time) && !this.cardClosed;
    $('card').hidden = !shown;
    if (shown) {
      showCard($('card'), log, time, () => {
        this.cardClosed = true;
        this.request();
      });
    }
    if (!$('controls').hidden) updateControls($('controls'), log, this.selected);
  }

  draw() {
    const { log, time } = this;
    this.tell();
    const wantsRoom = showStrips($('strips'), log, time, (name, at) => {
      this.select(name);
      this.seek(at);
    });
    if (wantsRoom) this.fitted = false;
    this.map.resize();
    if (!this.fitted) {
      if (log.isSpatial && !this.camera.chosen) {
        this.camera.spatial = true;
        this.camera.chosen = true;
        $('space').setAttribute('aria-pressed', 'true');
      }
      this.camera.fit(log.bounds);
      this.fitted = Boolean(log.scene.bounds) || !this.isLive;
    }
    this.map.marked = this.marked;
    // Also above one second of a fast replay.
    this.map.pulse = reducedMotion.matches ? 0 : Math.max(4, 1.2 * Number($('speed').value));
    this.map.draw(log, time, this.selected);
    showLegend($('legend'), log, time, this.selected, this.map);
    this.drawing.draw(this.map);
    this.reports.draw(this.map);
    this.reports.showFinds(log, time);
    this.curve.draw(log, time);
    showNumbers($('numbers'), $('counts'), log, time, this.map.unexplored);
    showRobots($('robots').tBodies[0], log, time, this.selected, (name) => this.select(name));
    showPictures($('cameras'), log, time, (name) => this.select(name));
    showWhy($('why_body'), log, time, this.selected, this.marked, (row) => this.mark(row));
    showLog($('log'), log, time, (event) => {
      if (log.slots.has(`decision/${event[4]}`)) this.select(event[4]);
      this.seek(event[0]);
    });
    drawMarks($('marks'), log);
    $('time').max = log.duration;
    $('time').value = time;
    $('clock').textContent = `${time.toFixed(1)} / ${log.duration.toFixed(1)} s`;
    this.changed = false;
    this.drawn += 1;
  }
}

const page = new Page();
// For tests and the browser's console.
window.maasi = page;
page.start();
setInterval(() => {
  if (page.changed && (page.following || page.drawn === 0 || !page.playing)) page.request();
}, 1000 / LIVE_RATE);
