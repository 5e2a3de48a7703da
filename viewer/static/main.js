// The page: connects the messages of the server to the views, and the controls to the server.

import { Connection } from './connection.js';
import { Controls } from './controls.js';
import { Gamepad } from './gamepad.js';
import { decodeMesh } from './mesh.js';
import { Notices } from './notices.js';
import { Plots } from './plots.js';
import { isInstructor, role, socketPath } from './role.js';
import { Stop } from './stop.js';
import { Task } from './task.js';
import { TimeLine } from './timeline.js';
import { Training } from './training.js';

const $ = (id) => document.getElementById(id);
const query = new URLSearchParams(location.search);

const seen = { hello: null, meshes: 0, moments: 0, plots: 0, playhead: null, nodes: [], notice: '' };
let stage = null;
let guide = null;
let canGuide = false;
let waiting = []; // for the stage, while it is being loaded

const notices = new Notices($('notices'));
const connection = new Connection({ text: take, binary: takeBinary }, showConnection, socketPath);
const send = (message) => {
  if (!connection.send(message)) notices.say('There is no connection: nothing was sent.', 'bad');
};
const controls = new Controls(send);
const stop = new Stop($('e-stop'), $('reset-e-stop'), connection, (text) => notices.say(text, 'bad'));
const timeline = new TimeLine(send);
const task = new Task();
const training = new Training(send, (text) => notices.say(text));
new Gamepad(() => guide, () => stop.active && stop.press());
let plots = new Plots($('plots'), null);

const takers = {
  hello: begin,
  controls: ({ refused }) => {
    controls.refused = refused[role];
    controls.enable();
    allowGuide();
  },
  state: (message) => {
    controls.showState(message);
    stop.show(message.e_stopped);
  },
  nodes: ({ rows }) => {
    seen.nodes = rows;
    controls.showNodes(rows);
  },
  session: (message) => {
    if (message.busy) guide?.forget();
    controls.showSession(message);
    if (seen.hello?.mode === 'live') $('title').textContent = [message.scene, message.method].filter(Boolean).join(' · ');
  },
  scale: (message) => controls.showScale(message),
  moment: (message) => {
    seen.moments += 1;
    onStage(() => stage.takeMoment(message));
    controls.showMoment(message, stage?.marks.height ?? null);
    canGuide = message.can_guide;
    allowGuide();
    guide?.show();
  },
  attempt: (message) => {
    task.show(message);
    onStage(() => stage.showBridge(message.bridge));
  },
  attempts: (message) => training.show(message),
  replay: (message) => training.open(message),
  plots: (message) => {
    seen.plots += 1;
    plots.show(message);
  },
  playhead: (message) => {
    seen.playhead = message;
    timeline.show(message);
    plots.mark(message.time);
  },
  notice: ({ id, text }) => {
    const known = `${id} ${text}`; // shown before the connection was lost
    if (known === seen.notice) return;
    seen.notice = known;
    notices.say(text);
  },
  refused: ({ why }) => notices.say(why, 'bad'),
};

function take(message) {
  const taker = takers[message.type];
  if (taker === undefined) return;
  taker(message);
}

/** Does something with the stage, once there is one. */
function onStage(job) {
  if (waiting !== null) waiting.push(job);
  else if (stage !== null) job();
}

function takeBinary(buffer) {
  const mesh = decodeMesh(buffer);
  seen.meshes += 1;
  onStage(() => stage.takeMesh(mesh));
}

function begin(hello) {
  const other = seen.hello?.mode !== hello.mode;
  seen.hello = hello;
  const live = hello.mode === 'live';
  document.body.dataset.mode = hello.mode;
  stop.active = live;
  timeline.active = !live;
  connection.expects = live;
  if (!live || other) $('title').textContent = live ? '' : hello.title; // a session says its scene
  if (other) {
    plots.clear();
    plots = new Plots($('plots'), live ? null : (time) => timeline.seek(time));
  }
  controls.begin(hello);
  timeline.begin(hello);
  task.begin(hello.exercise);
  training.begin(hello);
  $('training').hidden = !hello.session;
  onStage(() => {
    stage.begin(hello);
    guide.begin(hello);
    showGuide();
  });
}

// An unchanged message is not sent again: this is checked with each of the three.
function allowGuide() {
  const can = canGuide && connection.status === 'open' && controls.refused.guide === undefined;
  guide?.allow(can);
  $('guide').hidden = !can;
}

function showConnection() {
  const { status, stale, age, delay, reason } = connection;
  const open = status === 'open';
  if (controls.connected !== open) {
    controls.connected = open;
    controls.enable();
    if (!open) canGuide = false;
    allowGuide();
  }
  const words = { open: 'connected', connecting: 'connecting', lost: 'connection lost' };
  const slow = delay === null ? '' : ` · ${Math.round(delay)} ms`;
  $('link').dataset.link = stale ? 'stale' : status;
  $('link-text').textContent = stale ? `no news for ${(age / 1000).toFixed(0)} s` : words[status] + (open ? slow : '');
  let said = '';
  if (status === 'lost') {
    said = reason || 'Connection lost. The picture is old. The page reconnects by itself.';
  } else if (stale) {
    said = `No news from the session for ${(age / 1000).toFixed(0)} s. The picture is old.`;
  }
  document.body.classList.toggle('old', said !== '');
  if (said === '' && controls.state.held && !isInstructor) said = 'The instructor has paused.';
  $('banner').hidden = said === '';
  if ($('banner').textContent !== said) $('banner').textContent = said;
}

// The controls work without a picture, too: on a browser without WebGL, or while it is loaded.
async function openStage() {
  try {
    const [{ Stage }, { Guide }] = await Promise.all([import('./stage.js'), import('./guide.js')]);
    stage = new Stage($('view'), query.get('quality'));
    guide = new Guide($('view'), stage, (position, wxyz) => connection.send({ op: 'guide', position, wxyz }), showGuide, () => connection.stale);
    for (const job of waiting) job();
    connectViews();
    allowGuide();
  } catch (error) {
    console.error(error);
    $('hint').hidden = false;
    $('hint').textContent = 'This browser shows no picture in three dimensions: it has no WebGL. The controls work.';
  }
  waiting = null;
}

function connectViews() {
  const views = ['operator', 'top', 'tool'];
  for (const name of views) {
    $('views').querySelector(`[data-view=${name}]`).addEventListener('click', () => stage.view(name));
  }
  $('view').addEventListener('keydown', (event) => {
    const name = views[Number(event.key) - 1];
    if (event.target === $('view') && name !== undefined) stage.view(name);
  });
  const held = {
    up: () => guide.raise(0.001),
    down: () => guide.raise(-0.001),
    left: () => guide.turn('z', Math.PI / 36),
    right: () => guide.turn('z', -Math.PI / 36),
  };
  const switched = {
    follow: () => { guide.follows = !guide.follows; },
    cut: () => guide.hold('latch', $('guide').querySelector('[data-guide=cut]').ariaPressed !== 'true'),
    axes: () => { guide.byView = !guide.byView; },
  };
  for (const button of $('guide').querySelectorAll('button')) {
    const act = held[button.dataset.guide];
    if (act) repeat(button, act);
    else {
      button.addEventListener('click', () => {
        switched[button.dataset.guide]();
        showGuide();
      });
    }
  }
  showGuide();
}

/** Shows what the guide is set to: the server does not know it. */
function showGuide() {
  if (guide === null) return;
  const pressed = { follow: guide.follows, cut: guide.cutting, axes: guide.byView };
  for (const [name, on] of Object.entries(pressed)) {
    $('guide').querySelector(`[data-guide=${name}]`).setAttribute('aria-pressed', String(on));
  }
  const verb = stage.tool.cuts ? 'Cut' : 'Press';
  $('guide').querySelector('[data-guide=cut]').textContent = verb;
  const [word, length] = guide.cutting ? [`${verb} depth`, guide.depth] : ['Height', guide.height];
  $('guide-set').textContent = `${word} ${(1000 * length).toFixed(1)} mm`;
}

/** Does something once by a click, and again as long as a button is held. */
function repeat(button, act) {
  let timer = null;
  const end = () => clearInterval(timer);
  button.addEventListener('pointerdown', () => {
    act();
    end();
    timer = setInterval(act, 80);
  });
  for (const kind of ['pointerup', 'pointerleave', 'pointercancel']) button.addEventListener(kind, end);
  button.addEventListener('click', (event) => {
    if (event.detail === 0) act();
  });
}

function snapshot() {
  const tip = stage?.moment ? stage.project({ x: stage.moment.tip[0], y: stage.moment.tip[1], z: stage.moment.tip[2] }) : null;
  const parts = {};
  for (const [name, tissue] of stage?.tissues ?? []) parts[name] = tissue.counts;
  return {
    connection: connection.status,
    stale: connection.stale,
    mode: seen.hello?.mode ?? '',
    state: controls.state.state,
    text: controls.state.text,
    eStopped: controls.state.e_stopped,
    held: controls.state.held,
    ...controls.session,
    canGuide: guide?.allowed ?? false,
    cutting: guide?.cutting ?? false,
    goal: guide?.goal?.position.toArray() ?? null,
    bridge: stage?.bridge.place?.toArray() ?? null,
    meshes: seen.meshes,
    moments: seen.moments,
    plots: seen.plots,
    frames: stage?.frames ?? 0,
    parts,
    moment: stage?.moment ?? null,
    tip: tip && [tip.x, tip.y],
    camera: stage && {
      position: stage.camera.position.toArray(),
      target: stage.controls.target.toArray(),
      fov: (stage.camera.fov * Math.PI) / 180,
    },
    playhead: seen.playhead,
    nodes: seen.nodes,
    notices: [...notices.texts],
  };
}

/** For tests and films: the state of the page, the window position of a point of the tissue frame, and the camera. */
Object.defineProperty(window, 'page', {
  value: Object.freeze({
    get state() {
      return snapshot();
    },
    project(point) {
      const { x, y } = stage.project({ x: point[0], y: point[1], z: point[2] });
      return [x, y];
    },
    zoom(factor) {
      stage.zoom(factor);
    },
  }),
});

if (isInstructor) {
  document.title = $('name').textContent = `${document.title}: instructor`;
  $('view').setAttribute('aria-label', 'Tissue and tool in three dimensions');
}
openStage();
connection.open();
