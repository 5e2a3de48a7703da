// Lines over time on a canvas.

const COLOURS = ['#56b4e9', '#f0a33a', '#3fc99a', '#d68bb8']; // distinct for the colour-blind too
const DASHES = [[], [6, 4], [2, 3], [8, 3, 2, 3]];
const AXIS = '#93a1af', GRID = 'rgba(147, 161, 175, 0.2)';
const LEFT = 38, RIGHT = 8, TOP = 8, BOTTOM = 18; // [pixel]
const STEPS = [1, 2, 5];

/** The smallest of 1, 2, 5 times a power of ten that makes at most `count` steps of a length. */
function step(length, count) {
  const power = 10 ** Math.floor(Math.log10(length / count));
  return (STEPS.find((one) => length / (one * power) <= count) ?? 10) * power;
}

const written = (value) => String(Number(value.toPrecision(6)));

export class Plots {
  /** @param {HTMLElement} place of all plots @param {function} seek takes a time, or null */
  constructor(place, seek) {
    this._place = place;
    this._seek = seek;
    this._plots = [];
    this._mark = null;
  }

  /** Takes lines over a span. */
  show({ span, lines }) {
    while (this._plots.length > lines.length) this._plots.pop().figure.remove();
    lines.forEach((line, index) => {
      this._plots[index] ??= this._add();
      this._plots[index].take(line, span);
    });
  }

  /** Marks a time of a recorded session. */
  mark(time) {
    this._mark = time;
    for (const plot of this._plots) plot.mark(time);
  }

  clear() {
    while (this._plots.length > 0) this._plots.pop().figure.remove();
    this._mark = null;
  }

  _add() {
    const plot = new Plot(this._seek, this._mark);
    this._place.append(plot.figure);
    return plot;
  }
}

class Plot {
  constructor(seek, mark) {
    this.figure = document.createElement('figure');
    const caption = document.createElement('figcaption');
    this._title = document.createElement('span');
    this._value = document.createElement('output');
    this._legend = document.createElement('span');
    this._legend.className = 'legend';
    caption.append(this._title, this._legend, this._value);
    this._canvas = document.createElement('canvas');
    this._canvas.setAttribute('role', 'img');
    // The present time is a line of its own: drawing all lines again for each picture costs more than the tissue.
    this._mark = document.createElement('i');
    this._mark.className = 'now';
    this._mark.hidden = true;
    this.figure.append(caption, this._canvas, this._mark);
    this._line = null;
    this._names = '';
    this._now = mark;
    this._asked = false;
    new ResizeObserver(() => this._ask()).observe(this._canvas);
    if (seek !== null) this._seekBy(seek);
  }

  _seekBy(seek) {
    this._canvas.classList.add('seeks');
    this._canvas.addEventListener('pointerdown', (event) => {
      if (this._line === null) return;
      const box = this._canvas.getBoundingClientRect();
      const share = (event.clientX - box.x - LEFT) / (box.width - LEFT - RIGHT);
      const [begin, end] = this._span;
      seek(begin + Math.min(1, Math.max(0, share)) * (end - begin));
    });
  }

  take(line, span) {
    this._line = line;
    this._span = span;
    this._title.textContent = `${line.title} [${line.unit}]`;
    const names = Object.keys(line.values);
    if (names.join('\n') !== this._names) {
      this._names = names.join('\n');
      this._legend.replaceChildren(...(names.length > 1 ? names : []).map((name, index) => {
        const shown = document.createElement('i');
        shown.textContent = name;
        shown.className = `line-${index % COLOURS.length}`;
        return shown;
      }));
    }
    this._ask();
  }

  mark(time) {
    this._now = time;
    if (this._line !== null) this._drawNow();
  }

  _ask() {
    if (this._asked) return;
    this._asked = true;
    requestAnimationFrame(() => this._draw());
  }

  _draw() {
    this._asked = false;
    const width = this._canvas.clientWidth, height = this._canvas.clientHeight;
    if (this._line === null || width < LEFT + RIGHT + 10 || height < 40) return;
    const ratio = window.devicePixelRatio;
    const wide = Math.round(ratio * width), high = Math.round(ratio * height);
    if (this._canvas.width !== wide || this._canvas.height !== high) {
      this._canvas.width = wide;
      this._canvas.height = high;
    }
    const context = this._canvas.getContext('2d');
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const [begin, end] = this._span;
    const top = this._top();
    const right = width - RIGHT, bottom = height - BOTTOM;
    const x = (time) => LEFT + ((time - begin) / (end - begin || 1)) * (right - LEFT);
    const y = (value) => bottom - (Math.min(value, top) / top) * (bottom - TOP);
    this._axes(context, x, y, top, { right, bottom, height });
    this._lines(context, x, y);
    this._drawNow();
  }

  _top() {
    const { least, values } = this._line;
    let most = least;
    for (const line of Object.values(values)) for (const value of line) if (value > most) most = value;
    return least * 2 ** Math.ceil(Math.log2(most / least) - 1e-9);
  }

  _axes(context, x, y, top, { right, bottom, height }) {
    const [begin, end] = this._span;
    context.font = '11px system-ui, sans-serif';
    context.fillStyle = AXIS;
    context.strokeStyle = GRID;
    context.lineWidth = 1;
    context.setLineDash([]);
    context.beginPath();
    context.textAlign = 'right';
    context.textBaseline = 'middle';
    const up = step(top, 3);
    for (let value = 0; value <= top + 1e-9; value += up) {
      const at = Math.round(y(value)) + 0.5;
      context.moveTo(LEFT, at);
      context.lineTo(right, at);
      context.fillText(written(value), LEFT - 6, at);
    }
    context.textAlign = 'center';
    context.textBaseline = 'top';
    const along = step(end - begin || 1, 4);
    for (let time = Math.ceil(begin / along) * along; time <= end + 1e-9; time += along) {
      const at = Math.round(x(time)) + 0.5;
      context.moveTo(at, TOP);
      context.lineTo(at, bottom);
      context.fillText(written(time), Math.min(at, right - 6), height - BOTTOM + 5);
    }
    context.stroke();
  }

  _lines(context, x, y) {
    const { times, values } = this._line;
    context.save();
    context.beginPath();
    context.rect(LEFT, 0, this._canvas.clientWidth - LEFT - RIGHT + 2, this._canvas.clientHeight);
    context.clip();
    context.lineJoin = 'round';
    Object.values(values).forEach((line, index) => {
      context.beginPath();
      context.strokeStyle = COLOURS[index % COLOURS.length];
      context.setLineDash(DASHES[index % DASHES.length]);
      context.lineWidth = 1.8;
      let down = false;
      for (let i = 0; i < times.length; i += 1) {
        const known = Number.isFinite(line[i]);
        if (known && down) context.lineTo(x(times[i]), y(line[i]));
        else if (known) context.moveTo(x(times[i]), y(line[i]));
        down = known;
      }
      context.stroke();
    });
    context.restore();
  }

  _drawNow() {
    this._mark.hidden = this._now === null;
    if (this._now !== null) {
      const [begin, end] = this._span;
      const { offsetLeft, offsetTop, clientWidth, clientHeight } = this._canvas;
      const share = Math.min(1, Math.max(0, (this._now - begin) / (end - begin || 1)));
      this._mark.style.height = `${clientHeight - BOTTOM - TOP + 4}px`;
      this._mark.style.transform = `translate(${offsetLeft + LEFT + share * (clientWidth - LEFT - RIGHT)}px, ${offsetTop + TOP - 4}px)`;
    }
    this._say();
  }

  // The present values, in words too.
  _say() {
    const { times, values, title, unit } = this._line;
    let at = times.length - 1;
    if (this._now !== null) while (at > 0 && times[at] > this._now) at -= 1;
    const shown = Object.entries(values).map(([name, line]) => [name, line[at]])
      .filter(([, value]) => Number.isFinite(value))
      .map(([name, value]) => [name, value.toFixed(value >= 20 ? 0 : value >= 2 ? 1 : 2)]);
    const present = shown.map(([, value]) => value).join(' / ');
    if (this._value.textContent === present) return;
    this._value.textContent = present;
    const said = shown.map(([name, value]) => `${name} ${value} ${unit}`).join(', ');
    this._canvas.setAttribute('aria-label', `${title}: ${said}`);
  }
}
