// The panel of the exercise: its text, what its signs mean, the limits, progress and score.

const $ = (id) => document.getElementById(id);
const SIGNS = { targets: 'cut here, within the band', zones: 'do not cut', lesion: 'lesion: take it out whole' };

export class Task {
  begin(exercise) {
    const text = JSON.stringify(exercise);
    if (text !== this._known) this.show({ rows: [], score: null }); // of another exercise
    this._known = text;
    $('task').hidden = exercise === null;
    if (exercise === null) return;
    $('task-title').textContent = exercise.title;
    $('task-text').textContent = exercise.instruction;
    const shown = Object.keys(SIGNS).filter((kind) => exercise[kind] !== null && exercise[kind].length !== 0);
    $('task-signs').replaceChildren(...shown.map((kind) => {
      const item = document.createElement('li');
      item.dataset.sign = kind;
      item.textContent = SIGNS[kind];
      return item;
    }));
    $('task-limits').textContent = `Limits: ${exercise.time_limit} s, ${exercise.force_limit} N`;
  }

  /** Shows the progress of an attempt, and its score once there is one. */
  show({ rows, score }) {
    $('task-rows').replaceChildren(...rows.flatMap(({ name, value, over }) => {
      const [term, number] = ['dt', 'dd'].map((kind) => document.createElement(kind));
      term.textContent = name;
      number.textContent = over ? `▲ ${value}` : value;
      number.classList.toggle('over', over);
      return [term, number];
    }));
    $('task-score').hidden = score === null;
    if (score === null) return;
    $('task-points').textContent = `${score.passed ? '✓ passed' : '✕ not passed'}: ${score.points} of 100 points`;
    $('task-reasons').replaceChildren(...score.reasons.map((reason) => {
      const item = document.createElement('li');
      item.textContent = reason;
      return item;
    }));
  }
}
