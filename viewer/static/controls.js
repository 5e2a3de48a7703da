// The controls of a live session: buttons, choices, the state, the table of nodes.

import { fill } from './fill.js';
import { Gauge } from './gauge.js';
import { isInstructor } from './role.js';

const STATES = {
  ENABLED: ['▶', 'FORCE ON'], PAUSED: ['❚❚', 'PAUSED'], DISABLED: ['○', 'FORCE OFF'], FAULT: ['▲', 'FAULT'],
};
const LEVELS = [['●', 'ok'], ['▲', 'warning'], ['✕', 'error'], ['?', 'silent']];
const SCALE_MS = 100;
const FULL_FORCE = 5, FULL_DEPTH = 20; // [N], [mm] of the gauges without an exercise
const FACTORS = ['stiffness', 'toughness'];
const CONTACTS = ['free', 'touching', 'inside'];

const $ = (id) => document.getElementById(id);

export class Controls {
  /** @param {function} send sends a message of the page */
  constructor(send) {
    this._send = send;
    this.refused = {};
    this.connected = false;
    this.session = { scene: '', method: '', recording: '', busy: '', scenes: [] };
    this.state = { state: '', text: '', guided: '', e_stopped: false, held: false };
    this._lastScale = 0;
    [this._forceGauge, this._depthGauge] = ['force', 'depth'].map((name) => new Gauge($(`${name}-gauge`)));
    $('start').addEventListener('click', () => send(this._lifts ? { op: 'hold', on: false } : { op: 'start' }));
    $('pause').addEventListener('click', () => send(isInstructor ? { op: 'hold', on: true } : { op: 'pause' }));
    $('reset').addEventListener('click', () => send({ op: 'reset' }));
    $('set-tissue').hidden = !isInstructor;
    $('tissue').addEventListener('click', () => {
      send({ op: 'tissue', ...Object.fromEntries(FACTORS.map((name) => [name, Number($(name).value)])) });
    });
    for (const name of FACTORS) $(name).addEventListener('input', () => showFactor(name));
    $('record').addEventListener('click', () => send({ op: 'record', on: !this.session.recording }));
    for (const id of ['scene', 'method']) $(id).addEventListener('change', () => this._choose());
    $('scale').addEventListener('input', () => this._scale(false));
    $('scale').addEventListener('change', () => this._scale(true));
    this._hints = Object.fromEntries(['start', 'pause', 'reset', 'record', 'begin', 'tissue'].map((id) => [id, $(id).title]));
  }

  begin(hello) {
    this._scenes = hello.scenes;
    fill($('scene'), hello.scenes);
    fill($('method'), hello.methods);
    this._scaleGauges(hello.exercise);
    this.showSession(this.session);
  }

  // The allowed part of the force is up to its limit, of the depth the band of the targets.
  _scaleGauges(exercise) {
    const limit = exercise?.force_limit ?? FULL_FORCE;
    this._forceGauge.range(exercise ? 2 * limit : limit, [0, limit]);
    const bands = (exercise?.targets ?? []).map(({ depth }) => depth.map((end) => 1000 * end));
    const [low, high] = [Math.min(...bands.map(([end]) => end)), Math.max(...bands.map(([, end]) => end))];
    this._depthGauge.range(bands.length ? 2 * high : FULL_DEPTH, bands.length ? [low, high] : [0, FULL_DEPTH]);
  }

  showState(state) {
    this.state = state;
    const shown = state.held && state.state === 'DISABLED' ? 'PAUSED' : state.state;
    const [sign, name] = state.e_stopped ? ['■', 'E-STOP'] : STATES[shown] ?? ['…', 'WAITING'];
    $('state').dataset.state = state.e_stopped ? 'E_STOP' : shown;
    $('state-name').textContent = `${sign} ${name}`;
    const text = isInstructor ? state.text : [state.text, state.guided].join(' ').trim();
    $('state-text').textContent = text || (state.state ? '' : 'Waiting for the haptic bridge.');
    $('start').textContent = this._lifts ? 'Go on' : 'Start';
    this.enable();
  }

  // The instructor's own pause is lifted by the page of an instructor alone.
  get _lifts() {
    return isInstructor && this.state.held;
  }

  showSession(session) {
    const { stiffness, toughness } = this.session.tissue ?? {};
    const { tissue } = session;
    if (tissue && (tissue.stiffness !== stiffness || tissue.toughness !== toughness)) {
      for (const name of FACTORS) {
        $(name).value = tissue[name];
        showFactor(name);
      }
    }
    this.session = session;
    const scenes = session.scenes?.length ? session.scenes : this._scenes ?? [];
    fill($('scene'), scenes.includes(session.scene) || !session.scene ? scenes : [...scenes, session.scene]);
    if (session.scene) $('scene').value = session.scene;
    if (session.method) $('method').value = session.method;
    const recording = Boolean(session.recording);
    $('record').textContent = recording ? 'Stop recording' : 'Record';
    $('record').setAttribute('aria-pressed', String(recording));
    $('busy').hidden = !session.busy && !recording;
    $('busy').classList.toggle('recording', recording && !session.busy);
    $('busy').textContent = session.busy || `Recording ${session.recording}`;
    this.enable();
  }

  showScale({ value, min, max }) {
    const slider = $('scale');
    [slider.min, slider.max] = [min, max];
    if (document.activeElement !== slider || performance.now() - this._lastScale > 500) slider.value = value;
    $('scale-value').textContent = Number(value).toFixed(2).replace(/0$/, '');
  }

  showNodes(rows) {
    const body = $('nodes');
    while (body.rows.length > rows.length) body.deleteRow(-1);
    rows.forEach((row, index) => {
      const shown = body.rows[index] ?? newRow(body);
      const [sign, word] = LEVELS[row.level] ?? LEVELS[3];
      const texts = [sign, row.name, row.rate ? `${Math.round(row.rate)} Hz` : '', row.message];
      shown.className = `level-${word}`;
      shown.cells[0].setAttribute('aria-label', word);
      texts.forEach((text, column) => {
        if (shown.cells[column].textContent !== text) shown.cells[column].textContent = text;
      });
    });
  }

  /** @param {object} moment @param {number|null} height of the blade's end over the surface [m] */
  showMoment(moment, height) {
    $('hud').hidden = false;
    const force = Math.hypot(...moment.force);
    $('hud-force').textContent = force.toFixed(2);
    this._forceGauge.show(force);
    this._depthGauge.show(1000 * moment.depth);
    $('hud-clutch').hidden = !moment.clutched;
    const above = moment.depth === 0 && height > 0;
    $('hud-depth-name').textContent = above ? 'Height' : 'Depth';
    $('hud-depth').textContent = (1000 * (above ? height : moment.depth)).toFixed(1);
    $('hud-contact').textContent = CONTACTS[moment.contact] ?? '';
  }

  /** Disables requests that the server would refuse, and all without a connection. */
  enable() {
    const why = (op) => (this.connected ? this.refused[op] ?? '' : 'There is no connection.');
    const stand = (id, op, more = '') => {
      const reason = why(op) || more;
      $(id).disabled = Boolean(reason);
      $(id).title = reason || this._hints[id] || '';
    };
    const { state, held } = this.state;
    if (this._lifts) stand('start', 'hold', this.state.e_stopped ? 'An E-STOP holds: reset it first.' : '');
    else stand('start', 'start', state === 'ENABLED' ? 'The force is on.' : '');
    if (isInstructor) stand('pause', 'hold', held ? 'You have paused.' : '');
    else stand('pause', 'pause', state === 'PAUSED' ? 'It is paused.' : '');
    stand('reset', 'reset');
    stand('record', 'record');
    stand('scene', 'choose');
    stand('method', 'choose');
    stand('begin', 'attempt');
    stand('scale', 'scale');
    for (const id of ['tissue', ...FACTORS]) stand(id, 'tissue');
  }

  _choose() {
    this._send({ op: 'choose', scene: $('scene').value, method: $('method').value });
    this.showSession(this.session); // until the server confirms the choice
  }

  _scale(last) {
    const now = performance.now();
    clearTimeout(this._scaleTimer);
    if (!last && now - this._lastScale < SCALE_MS) {
      this._scaleTimer = setTimeout(() => this._scale(true), SCALE_MS);
      return;
    }
    this._lastScale = now;
    this._send({ op: 'scale', value: Number($('scale').value) });
  }
}

function showFactor(name) {
  $(`${name}-value`).textContent = Number($(name).value).toFixed(1);
}

function newRow(body) {
  const row = body.insertRow();
  for (let i = 0; i < 4; i += 1) row.insertCell();
  return row;
}
