// A live run: its events as they arrive, and its controls if enabled.

import { isStopped, RunLog } from './run_log.js';
import { button, element } from './text.js';
import { modeOf } from './words.js';

export function follow(onLog, onEvents, onState) {
  const source = new EventSource(`events${window.location.search}`);
  source.addEventListener('scene', (message) => {
    onLog(new RunLog(JSON.parse(message.data)));
    onState('live');
  });
  source.addEventListener('events', (message) => onEvents(JSON.parse(message.data)));
  source.addEventListener('end', () => {
    source.close();
    onState('ended');
  });
  source.onerror = () => onState('connection lost');
}

// Send a statement or a command, with the token of the address; return the answer.
export async function send(path, body, signal) {
  const token = new URLSearchParams(window.location.search).get('token') || '';
  const reply = await fetch(path, {
    method: 'POST',
    signal,
    headers: { 'Content-Type': 'application/json', 'X-Maasi-Token': token },
    body: JSON.stringify(body),
  });
  return reply.json();
}

const COMMANDS = [['start', 'Start'], ['pause', 'Pause'], ['resume', 'Resume'], ['home', 'Send home'], ['stop', 'Stop'], ['release', 'Release']];
const HINTS = {
  stop: 'Stop the selected robot, or all robots if none is selected, until released',
  release: 'Let the selected robot, or all robots, accept goals again after a stop',
};
// Modes of a robot in which a command has an effect; other commands always may.
const USEFUL = {
  start: ['waiting for start', 'stopped'],
  pause: ['searching', 'sent home'],
  resume: ['paused', 'sent home'],
  home: ['waiting for start', 'searching', 'paused', 'stopped'],
};

// Disable buttons without effect, if the modes are known.
export function updateControls(parent, log, selected) {
  const names = selected ? [selected] : log.robots();
  for (const button of parent.querySelectorAll('[data-command]')) {
    const { command } = button.dataset;
    const modes = names.map((name) => modeOf(log, name, Infinity));
    let useful = !USEFUL[command] || modes.length === 0 || modes.some((mode) => !mode || USEFUL[command].includes(mode));
    if (command === 'home' && log.isOfBuildings) useful = false;
    if (command === 'release' && names.length) {
      useful = names.map((name) => log.at('robot', name, Infinity)).some((event) => event && isStopped(event));
    }
    button.disabled = !useful;
  }
}

// Show the controls.
export function showControls(parent, selectedRobot) {
  const answer = element('span', 'quiet', '');
  answer.setAttribute('role', 'status');
  answer.title = 'Click to hide';
  answer.onclick = () => answer.replaceChildren();
  const waiting = new Set();
  for (const [command, title] of COMMANDS) {
    const control = button(title, async () => {
      const robot = selectedRobot();
      answer.textContent = `${command} ${robot || 'all'} ...`;
      // A browser queues requests beyond six connections: a stop aborts those that it supersedes.
      for (const other of waiting) {
        if (command === 'stop' && (robot === null || other.command !== 'stop')) other.abort.abort();
      }
      const request = { command, abort: new AbortController() };
      waiting.add(request);
      try {
        const { message } = await send('control', { command, robot }, request.abort.signal);
        const complete = message.startsWith(`${command}: `);
        answer.textContent = complete ? message : `${command} ${robot || 'all'}: ${message}`;
      } catch (error) {
        if (!request.abort.signal.aborted) answer.textContent = `${command}: no answer`;
      } finally {
        waiting.delete(request);
      }
    }, { command });
    control.title = HINTS[command] || 'For the selected robot, or for the whole search if none is selected';
    parent.append(control);
  }
  parent.append(answer);
  parent.hidden = false;
}
