(function () {
'use strict';
var token = document.querySelector('meta[name=token]').content;
var alertBox = document.getElementById('alert'), panel = document.getElementById('panel');

/* Elements with text (never markup). */
function make(tag, parent, text, settings) {
  var e = document.createElement(tag);
  if (text) e.textContent = text;
  Object.keys(settings || {}).forEach(function (k) { e.setAttribute(k, settings[k]); });
  if (parent) parent.appendChild(e);
  return e;
}
function draw(tag, parent, settings, text) {
  var e = document.createElementNS('http://www.w3.org/2000/svg', tag);
  Object.keys(settings || {}).forEach(function (k) { e.setAttribute(k, settings[k]); });
  if (text !== undefined) e.textContent = text;
  parent.appendChild(e);
  return e;
}
function digits(x, n) { return String(Number(x.toPrecision(n))).replace('-', '−'); }

/* What went wrong: what was found, where, what to do. */
function complain(error) {
  alertBox.textContent = '';
  make('p', make('div', alertBox), '').appendChild(make('b', null, error.error || String(error)));
  if (error.where) make('p', alertBox, 'Where: ' + error.where);
  if (error.hint) make('p', alertBox, 'What to do: ' + error.hint);
  alertBox.hidden = false;
  alertBox.scrollIntoView({block: 'nearest'});
}
function say(text) { if (text) sessionStorage.setItem('said', text); }

/* Ask the server to do something; the page is shown anew with what became of it. */
function act(what, values) {
  alertBox.hidden = true;
  return fetch('/do/' + what, {method: 'POST', headers: {'Content-Type': 'application/json', 'X-Operando-Token': token}, body: JSON.stringify(values || {})})
    .then(function (answer) {
      return answer.json().catch(function () { return {error: 'the workbench does not answer as expected', hint: 'load the page again'}; }).then(function (found) {
        if (!answer.ok) { complain(found); return refresh(); }
        say(found.said);
        return ['run', 'add', 'candidate', 'suggested', 'remove', 'save'].indexOf(what) >= 0 ? refresh() : renew();
      });
    }, function () { complain({error: 'the workbench does not answer', hint: 'was it ended in its terminal?'}); });
}
/* The content and the panel anew, without leaving the page: zoom and position stay. */
function renew() {
  return fetch(location.pathname).then(function (answer) { return answer.text(); }).then(function (text) {
    var made = new DOMParser().parseFromString(text, 'text/html'), old = document.getElementById('content'), now = made.getElementById('content');
    if (!now) { location.reload(); return; }
    var shown = document.getElementById('diagram'), focus = label(document.activeElement);
    panel.replaceChildren.apply(panel, Array.from(made.getElementById('panel').childNodes));
    old.replaceChildren.apply(old, Array.from(now.childNodes));
    begin(shown && shown.zoom);
    var again = focus && Array.from(document.querySelectorAll('[aria-label]')).find(function (e) { return e.getAttribute('aria-label') === focus; });
    if (again) again.focus();
  });
}
function label(e) { return e && e.getAttribute && e.getAttribute('aria-label'); }
var busy = null;
function refresh() {
  return fetch('/panel').then(function (answer) { return answer.text(); }).then(function (text) {
    var open = panel.querySelector('details[open]');
    panel.replaceChildren.apply(panel, Array.from(new DOMParser().parseFromString(text, 'text/html').body.childNodes));
    if (open && panel.querySelector('details')) panel.querySelector('details').open = true;
    var was = busy;
    watch();
    if (was === 'yes' && busy === 'no') return renew();
  }, function () { complain({error: 'the workbench does not answer', hint: 'was it ended in its terminal?'}); });
}
function watch() {
  var state = document.getElementById('state');
  busy = state ? state.dataset.busy : null;
  if (busy === 'yes') setTimeout(refresh, 800);
}

document.addEventListener('click', function (e) {
  var b = e.target.closest('button[data-do]');
  if (!b || b.disabled) return;
  var values = {};
  ['state', 'channel'].forEach(function (k) { if (b.dataset[k] !== undefined) values[k] = b.dataset[k]; });
  ['hz', 'number', 'step'].forEach(function (k) { if (b.dataset[k] !== undefined) values[k] = Number(b.dataset[k]); });
  act(b.dataset.do, values);
});
function number(field) { return field.value.trim() === '' ? null : Number(field.value); }
document.addEventListener('submit', function (e) {
  var f = e.target;
  e.preventDefault();
  if (f.className === 'exclude') act('exclude', {channel: f.dataset.channel, reason: f.elements.reason.value});
  else if (f.id === 'bands') {
    var from = f.querySelectorAll('[name=from]'), to = f.querySelectorAll('[name=to]'), pairs = [];
    from.forEach(function (a, i) { if (number(a) !== null || number(to[i]) !== null) pairs.push([number(a), number(to[i])]); });
    act('bands', {low: number(f.elements.low), high: number(f.elements.high), excluded: pairs});
  } else if (f.id === 'effect') {
    var at = f.querySelector('fieldset:not([hidden])'), values = {}, dofs = [];
    at.querySelectorAll('[name=dof]').forEach(function (d) { dofs.push(d.value); });
    at.querySelectorAll('input.value').forEach(function (v) { values[v.name] = v.value; });
    act('add', {kind: f.elements.kind.value, dofs: dofs, values: values, fix: f.elements.fix.checked});
  }
});
function effectForm() {
  var form = document.getElementById('effect');
  if (!form) return;
  function choose() {
    form.querySelectorAll('fieldset').forEach(function (s) { s.hidden = s.disabled = s.dataset.kind !== form.elements.kind.value; });
  }
  form.elements.kind.addEventListener('change', choose);
  choose();
}

/* The stabilisation diagram. */
function ticks(low, high, most) {
  var raw = (high - low) / most, size = Math.pow(10, Math.floor(Math.log10(raw))), out = [];
  var step = [1, 2, 5, 10].map(function (m) { return m * size; }).find(function (s) { return s >= raw; });
  for (var v = Math.ceil(low / step - 1e-9) * step; v <= high + 1e-9 * step; v += step) out.push(Number(v.toPrecision(10)));
  return out;
}
function Diagram(host, data, zoom) {
  this.host = host; this.data = data; this.x = zoom || data.limits.slice(); this.shown = {};
  var self = this, tools = make('div', host, '', {'class': 'tools'});
  [['+', '+ Zoom in', 0.5], ['−', '− Zoom out', 2], ['All', 'All of the band', 0]].forEach(function (b) {
    make('button', tools, b[0], {type: 'button', 'aria-label': b[1]}).addEventListener('click', function () { self.scale(b[2]); });
  });
  Object.keys(data.letters).forEach(function (l) {
    if (data.poles.letter.indexOf(l) < 0) return;
    var name = make('label', tools), box = make('input', name, '', {type: 'checkbox'});
    self.shown[l] = box.checked = l !== '';
    make('span', name, ' ' + (l || '×') + ' ' + data.letters[l].name).style.color = data.letters[l].color;
    box.addEventListener('change', function () { self.shown[l] = box.checked; self.draw(); });
  });
  data.behind.map(function (c) { return c.name; }).filter(function (n, i, all) { return all.indexOf(n) === i; }).forEach(function (n) {
    make('span', tools, n + (n === 'MMIF' ? ' (green, dotted, 0 to 1)' : ' (grey, logarithmic)'));
  });
  this.svg = draw('svg', host, {role: 'img', 'aria-label': 'Stabilisation diagram; its modes and stable poles stand in the tables below'});
  this.note = make('p', host, '', {'class': 'readout', 'aria-live': 'polite'});
  var from = null;
  this.svg.addEventListener('pointerdown', function (e) { from = self.at(e).px; });
  this.svg.addEventListener('pointermove', function (e) { self.hover(self.at(e), from); });
  this.svg.addEventListener('pointerleave', function () { from = null; self.mark(null); });
  this.svg.addEventListener('pointerup', function (e) {
    var p = self.at(e), start = from;
    from = null;
    if (start !== null && Math.abs(p.px - start) > 8) self.zoomTo(self.hz(Math.min(start, p.px)), self.hz(Math.max(start, p.px)));
    else if (start !== null) self.choose(p);
  });
  this.draw();
}
Diagram.prototype = {
  hz: function (px) { return this.x[0] + (px - this.left) / this.w * (this.x[1] - this.x[0]); },
  px: function (hz) { return this.left + (hz - this.x[0]) / (this.x[1] - this.x[0]) * this.w; },
  py: function (order) { return this.top + this.h * (1 - (order - this.low) / (this.high - this.low)); },
  at: function (e) { var r = this.svg.getBoundingClientRect(); return {px: e.clientX - r.left, py: e.clientY - r.top}; },
  scale: function (by) {
    var middle = (this.x[0] + this.x[1]) / 2, half = (this.x[1] - this.x[0]) / 2 * by;
    if (by) this.zoomTo(middle - half, middle + half); else this.zoomTo(this.data.limits[0], this.data.limits[1]);
  },
  zoomTo: function (a, b) {
    this.x = [Math.max(a, this.data.limits[0]), Math.min(b, this.data.limits[1])];
    this.host.zoom = this.x;
    this.draw();
  },
  draw: function () {
    var s = this.svg, d = this.data, self = this, width = this.host.clientWidth - 22, height = width < 600 ? 340 : 430;
    if (width < 100) return;
    s.textContent = '';
    s.setAttribute('viewBox', '0 0 ' + width + ' ' + height);
    this.left = 44; this.w = width - this.left - 8; this.top = 26; this.h = height - this.top - 40;
    var orders = d.poles.order;
    this.high = Math.max.apply(null, orders.concat([2])) + 1; this.low = Math.min(0, Math.min.apply(null, orders.concat([2])) - 2);
    var clip = draw('clipPath', s, {id: 'inside'});
    draw('rect', clip, {x: this.left, y: 0, width: this.w, height: height});
    ticks(this.x[0], this.x[1], Math.max(3, this.w / 90)).forEach(function (v) {
      draw('line', s, {x1: self.px(v), x2: self.px(v), y1: self.top, y2: self.top + self.h, stroke: '#e4e8ec'});
      draw('text', s, {x: self.px(v), y: self.top + self.h + 16, 'text-anchor': 'middle'}, digits(v, 6));
    });
    ticks(Math.max(this.low, 0), this.high, 6).forEach(function (v) {
      draw('text', s, {x: self.left - 6, y: self.py(v) + 4, 'text-anchor': 'end'}, digits(v, 4));
    });
    draw('rect', s, {x: this.left, y: this.top, width: this.w, height: this.h, fill: 'none', stroke: '#4b5762'});
    draw('text', s, {x: this.left + this.w / 2, y: height - 6, 'text-anchor': 'middle'}, 'Frequency [Hz]');
    draw('text', s, {x: 12, y: this.top + this.h / 2, 'text-anchor': 'middle', transform: 'rotate(-90 12 ' + (this.top + this.h / 2) + ')'}, 'Model order');
    var inside = draw('g', s, {'clip-path': 'url(#inside)'}), seen = {};
    d.band.forEach(function (f) { draw('line', inside, {x1: self.px(f), x2: self.px(f), y1: self.top, y2: self.top + self.h, stroke: '#4b5762', 'stroke-dasharray': '1 4'}); });
    d.behind.forEach(function (c) {
      var path = '', first = !seen[c.name];
      c.hz.forEach(function (f, i) { path += (path ? 'L' : 'M') + self.px(f).toFixed(1) + ' ' + (self.top + self.h * (0.98 - 0.94 * c.values[i])).toFixed(1); });
      var dotted = c.name === 'MMIF';
      draw('path', inside, {d: path, fill: 'none', stroke: dotted ? '#5aa38a' : first ? '#8795a2' : '#c3ccd4', 'stroke-width': first && !dotted ? 1.3 : 0.9, 'stroke-dasharray': dotted ? '2 2' : 'none'});
      seen[c.name] = true;
    });
    d.harmonics.forEach(function (f) { draw('line', inside, {x1: self.px(f), x2: self.px(f), y1: self.top, y2: self.top + self.h, stroke: '#1f2933', 'stroke-dasharray': '5 4'}); });
    d.poles.hz.forEach(function (f, i) {
      var l = d.poles.letter[i];
      if (f < self.x[0] || f > self.x[1] || !self.shown[l]) return;
      draw('text', inside, {x: self.px(f), y: self.py(d.poles.order[i]) + 4, 'text-anchor': 'middle', 'class': 'pole'}, l || '×').style.fill = d.letters[l].color;
    });
    var last = -99;
    d.modes.forEach(function (m) {
      var color = {taken: '#00558a', 'left out': '#a33a00', 'to come': '#00664a'}[m.now], x = self.px(m.hz);
      draw('line', inside, {x1: x, x2: x, y1: self.top, y2: self.top + self.h, stroke: color, 'stroke-width': m.now === 'taken' ? 1 : 2, 'stroke-dasharray': m.now === 'left out' ? '6 4' : 'none', opacity: 0.75});
      if (x - last < 16 && m.now === 'taken') return;
      draw('text', inside, {x: Math.max(x, last + 14), y: self.top - 8, 'text-anchor': 'middle'}, m.now === 'to come' ? '+' : m.now === 'left out' ? '−' + m.number : String(m.number)).style.fill = color;
      last = x;
    });
    this.cursor = draw('circle', s, {r: 8, fill: 'none', stroke: '#1f2933', 'stroke-width': 1.5, visibility: 'hidden'});
    this.range = draw('rect', s, {y: this.top, height: this.h, fill: '#00558a', opacity: 0.12, visibility: 'hidden'});
  },
  mode: function (p) {
    var self = this, near = this.data.modes.slice().sort(function (a, b) { return Math.abs(self.px(a.hz) - p.px) - Math.abs(self.px(b.hz) - p.px); })[0];
    return near && Math.abs(this.px(near.hz) - p.px) <= 6 ? near : null;
  },
  pole: function (p) {
    var d = this.data.poles, best = -1, far = 16;
    for (var i = 0; i < d.hz.length; i++) {
      if (!this.shown[d.letter[i]]) continue;
      var away = Math.hypot(this.px(d.hz[i]) - p.px, this.py(d.order[i]) - p.py);
      if (away < far) { far = away; best = i; }
    }
    return best;
  },
  hover: function (p, from) {
    var dragging = from !== null && Math.abs(p.px - from) > 8, i = this.pole(p), m = this.mode(p), d = this.data, said = [];
    this.range.setAttribute('visibility', dragging ? 'visible' : 'hidden');
    if (dragging) { this.range.setAttribute('x', Math.min(from, p.px)); this.range.setAttribute('width', Math.abs(p.px - from)); }
    this.mark(i);
    if (i >= 0) said.push('Pole ' + digits(d.poles.hz[i], 6) + ' Hz, damping ' + digits(100 * d.poles.damping[i], 3) + ' %, order ' + d.poles.order[i] + ', ' + d.letters[d.poles.letter[i]].name);
    if (m) said.push((m.number === null ? 'Mode to come' : 'Mode ' + m.number) + ', ' + digits(m.hz, 6) + ' Hz, ' + (m.now === 'left out' ? 'left out: choose it to take it again' : m.now + ': choose it to leave it out'));
    this.note.textContent = said.join(' · ') || digits(this.hz(p.px), 5) + ' Hz';
  },
  mark: function (i) {
    var on = i !== null && i >= 0;
    this.cursor.setAttribute('visibility', on ? 'visible' : 'hidden');
    if (on) { this.cursor.setAttribute('cx', this.px(this.data.poles.hz[i])); this.cursor.setAttribute('cy', this.py(this.data.poles.order[i])); }
  },
  choose: function (p) {
    var m = this.mode(p), i = this.pole(p), state = this.data.state;
    if (m) act(m.now === 'left out' ? 'take' : 'leave', {state: state, hz: m.hz});
    else if (i >= 0 && 'svd'.indexOf(this.data.poles.letter[i] || '-') >= 0) act('take', {state: state, hz: this.data.poles.hz[i]});
    else if (i >= 0) this.note.textContent = 'This pole is not stable (' + this.data.letters[this.data.poles.letter[i]].name + '): choose one with the letter s, v or d.';
  }
};
function begin(zoom) {
  var host = document.getElementById('diagram'), said = sessionStorage.getItem('said');
  sessionStorage.removeItem('said');
  effectForm();
  if (!host) return;
  fetch('/diagram/' + host.dataset.state).then(function (answer) { return answer.json(); }).then(function (data) {
    if (!data.poles) { complain(data); return; }
    var made = new Diagram(host, data, zoom);
    host.zoom = zoom; host.made = made;
    if (said) made.note.textContent = said;
    window.onresize = function () { made.draw(); };
  });
}
begin();
watch();
})();
