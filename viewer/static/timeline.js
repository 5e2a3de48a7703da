// The time line of a recorded session.

const SEEK_MS = 50;
const $ = (id) => document.getElementById(id);

export class TimeLine {
  /** @param {function} send takes a message of the page */
  constructor(send) {
    this._send = send;
    this._playing = false;
    this._held = false;
    this._end = 0;
    $('play').addEventListener('click', () => this.toggle());
    $('seek').addEventListener('input', () => {
      this._held = true;
      this.seek(Number($('seek').value));
    });
    $('seek').addEventListener('change', () => {
      this._held = false;
    });
    $('speed').addEventListener('change', () => send({ op: 'speed', value: Number($('speed').value) }));
    window.addEventListener('keydown', (event) => this._key(event));
    this.active = false;
  }

  begin(hello) {
    this._end = hello.duration ?? 0;
    $('seek').max = this._end;
    const options = (hello.speeds ?? []).map((speed) => new Option(`${speed} ×`, speed));
    $('speed').replaceChildren(...options);
  }

  show({ time, playing, speed }) {
    this._playing = playing;
    $('play').textContent = playing ? 'Pause' : 'Play';
    if (!this._held) $('seek').value = time;
    $('clock').textContent = `${time.toFixed(2)} of ${this._end.toFixed(2)} s`;
    $('speed').value = speed;
  }

  toggle() {
    this._send({ op: 'play', on: !this._playing });
  }

  /** Goes to a time [s]; of many, the newest. */
  seek(time) {
    this._wanted = Math.min(this._end, Math.max(0, time));
    this._timer ??= setTimeout(() => {
      this._timer = null;
      this._send({ op: 'seek', time: this._wanted });
    }, SEEK_MS);
  }

  _key(event) {
    if (!this.active || event.code !== 'Space') return;
    if (['BUTTON', 'SELECT'].includes(event.target.tagName)) return;
    event.preventDefault();
    this.toggle();
  }
}
