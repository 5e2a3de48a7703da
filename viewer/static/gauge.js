// A gauge: a bar with its allowed part, for a value that is also written beside it.

export class Gauge {
  /** @param {HTMLElement} element of the role meter */
  constructor(element) {
    this._element = element;
    this._bar = element.appendChild(document.createElement('i'));
    this.range(1, [0, 1]);
  }

  /** @param {number} full value of the whole bar @param {number[]} allowed lowest and highest good value */
  range(full, allowed) {
    this._full = full;
    this._allowed = allowed;
    this._element.ariaValueMin = '0';
    this._element.ariaValueMax = String(full);
    const [low, high] = allowed.map((value) => `${(100 * value) / full}%`);
    this._element.style.setProperty('--low', low);
    this._element.style.setProperty('--high', high);
  }

  show(value) {
    const shown = Math.min(value, this._full);
    this._element.ariaValueNow = shown.toFixed(1);
    this._bar.style.width = `${(100 * shown) / this._full}%`;
    this._element.classList.toggle('over', value > this._allowed[1]);
  }
}
