// Exercises to begin, attempts that were made, and replays of them.

import { fill } from './fill.js';

const $ = (id) => document.getElementById(id);
const MAX_CHOSEN = 2;

export class Training {
  /** @param {function} send takes a message of the page @param {function} say takes a notice */
  constructor(send, say) {
    this._send = send;
    this._say = say;
    this._chosen = []; // names of bags
    this._number = 0;
    this._window = null;
    $('begin').addEventListener('click', () => this._begin());
    $('watch').addEventListener('click', () => this._watch());
    $('subject').addEventListener('input', () => $('subject').reportValidity());
  }

  begin({ exercises }) {
    fill($('exercise'), exercises.map(({ name }) => name), exercises.map(({ title }) => title));
  }

  /** Shows the attempts, newest first. */
  show({ rows }) {
    const names = rows.map(({ bag }) => bag);
    this._chosen = this._chosen.filter((bag) => names.includes(bag));
    $('attempts').replaceChildren(...rows.map((row) => this._row(row)));
    $('attempts-none').hidden = rows.length > 0;
    this._enable();
  }

  _row(row) {
    const shown = document.createElement('tr');
    const box = document.createElement('input');
    box.type = 'checkbox';
    box.value = row.bag;
    box.checked = this._chosen.includes(row.bag);
    box.setAttribute('aria-label', `Choose attempt ${row.attempt} of ${row.subject} at ${row.exercise}`);
    box.addEventListener('change', () => this._choose(row.bag, box.checked));
    const cells = [0, 1, 2].map(() => shown.insertCell());
    cells[0].append(box);
    const [task, who] = ['strong', 'span'].map((kind) => document.createElement(kind));
    task.textContent = row.exercise;
    who.textContent = `${row.subject}, attempt ${row.attempt}`;
    cells[1].append(task, who);
    cells[2].textContent = row.points === null ? row.state : `${row.passed ? '✓' : '✕'} ${row.points.toFixed(1)}`;
    cells[2].title = row.points === null ? '' : row.passed ? 'passed' : 'not passed';
    shown.title = `${row.bag}, ${new Date(1000 * row.begun).toLocaleString()}`;
    return shown;
  }

  _choose(bag, on) {
    this._chosen = this._chosen.filter((one) => one !== bag);
    if (on) this._chosen.push(bag);
    this._chosen = this._chosen.slice(-MAX_CHOSEN);
    for (const box of $('attempts').querySelectorAll('input')) box.checked = this._chosen.includes(box.value);
    this._enable();
  }

  _enable() {
    $('watch').disabled = this._chosen.length === 0;
    $('watch').textContent = this._chosen.length > 1 ? 'Compare the replays' : 'Replay';
  }

  _begin() {
    if (!$('subject').reportValidity()) return;
    this._send({ op: 'attempt', scene: $('exercise').value, subject: $('subject').value });
  }

  // A window that is opened later than the click is a pop-up to the browser.
  _watch() {
    this._number = Date.now();
    this._window = window.open('', 'replay');
    const said = 'The replay is being read ...';
    if (this._window) this._window.document.body.textContent = said;
    this._say(said);
    this._send({ op: 'watch', bags: this._chosen, number: this._number });
  }

  /** Opens the replay that this page has asked for. */
  open({ number, link }) {
    if (number !== this._number) return;
    this._number = 0;
    $('replay').href = link;
    $('replay').hidden = false;
    if (this._window && !this._window.closed) this._window.location.replace(link);
  }
}
