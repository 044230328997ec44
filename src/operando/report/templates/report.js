addEventListener('beforeprint', function () { document.querySelectorAll('details').forEach(function (d) { d.open = true; }); });
(function () {
'use strict';
/* Small helpers: elements with text (never markup), typed arrays from base64, numbers in words. */
function make(tag, parent, text, settings) {
  var e = document.createElement(tag);
  if (text) e.textContent = text;
  Object.keys(settings || {}).forEach(function (k) { e.setAttribute(k, settings[k]); });
  if (parent) parent.appendChild(e);
  return e;
}
function bytes(text) { return Uint8Array.from(atob(text), function (c) { return c.charCodeAt(0); }); }
function floats(text) { return new Float32Array(bytes(text).buffer); }
function words16(text) { return new Uint16Array(bytes(text).buffer); }
function digits(x, n) { return Number.isFinite(x) ? String(Number(x.toPrecision(n || 5))).replace('-', '−') : '–'; }
function button(parent, text, label, act) {
  var b = make('button', parent, text, {type: 'button', 'aria-label': label});
  b.addEventListener('click', act);
  return b;
}
function chooser(parent, label, names, act) {
  var l = make('label', parent, label + ' '), s = make('select', l);
  names.forEach(function (n, i) { make('option', s, n, {value: i}); });
  s.addEventListener('change', act);
  return s;
}
function ticks(low, high, most) {
  var raw = (high - low) / most, size = Math.pow(10, Math.floor(Math.log10(raw))), out = [];
  var step = [1, 2, 5, 10].map(function (m) { return m * size; }).find(function (s) { return s >= raw; });
  for (var v = Math.ceil(low / step) * step; v <= high + 1e-9 * step; v += step) out.push(Math.abs(v) < 1e-9 * step ? 0 : v);
  return out;
}
/* A canvas that fits its place and the screen's pixels. */
function sized(canvas, height) {
  var ratio = window.devicePixelRatio || 1, width = canvas.parentNode.clientWidth;
  canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
  canvas.style.height = height + 'px';
  var g = canvas.getContext('2d');
  g.setTransform(ratio, 0, 0, ratio, 0, 0);
  g.clearRect(0, 0, width, height);
  g.font = '12px "Helvetica Neue", Arial, "Liberation Sans", sans-serif';
  return {g: g, w: width, h: height};
}
/* Panels over one frequency axis: drag to zoom, buttons and keys for the same, the cursor reads. */
function Chart(host, label, full, provide, read) {
  var self = this;
  this.full = full; this.x = full.slice(); this.cursor = null; this.provide = provide; this.read = read;
  this.tools = make('div', host, '', {'class': 'tools'});
  this.box = make('div', host);
  this.canvas = make('canvas', this.box, '', {tabindex: 0, role: 'img', 'aria-label': label});
  this.note = make('p', host, '', {'class': 'readout', 'aria-live': 'polite'});
  var from = null, c = this.canvas;
  function at(e) { var r = c.getBoundingClientRect(); return self.value(e.clientX - r.left); }
  c.addEventListener('pointerdown', function (e) { from = at(e); });
  c.addEventListener('pointermove', function (e) { self.cursor = at(e); self.drag = from; self.draw(); });
  c.addEventListener('pointerleave', function () { self.drag = from = null; });
  c.addEventListener('pointerup', function (e) {
    var to = at(e), a = from;
    self.drag = from = null;
    if (a !== null && Math.abs(to - a) > 0.01 * (self.x[1] - self.x[0])) self.zoom(Math.min(a, to), Math.max(a, to)); else self.draw();
  });
  c.addEventListener('dblclick', function () { self.zoom(full[0], full[1]); });
  c.addEventListener('keydown', function (e) {
    var span = self.x[1] - self.x[0], middle = (self.x[0] + self.x[1]) / 2;
    var to = {'+': [middle - span / 4, middle + span / 4], '-': [middle - span, middle + span], Home: full,
      ArrowLeft: [self.x[0] - span / 4, self.x[1] - span / 4], ArrowRight: [self.x[0] + span / 4, self.x[1] + span / 4]}[e.key];
    if (to) { e.preventDefault(); self.zoom(to[0], to[1]); }
  });
  addEventListener('resize', function () { self.draw(); });
}
Chart.prototype.buttons = function () {
  var self = this, group = make('span', this.tools, '', {'class': 'group'});
  button(group, '+', 'Zoom in', function () { self.scale(0.5); });
  button(group, '−', 'Zoom out', function () { self.scale(2); });
  button(group, 'All', 'All of the band', function () { self.zoom(self.full[0], self.full[1]); });
};
Chart.prototype.scale = function (by) {
  var middle = this.cursor !== null && this.cursor > this.x[0] && this.cursor < this.x[1] ? this.cursor : (this.x[0] + this.x[1]) / 2;
  this.zoom(middle - (middle - this.x[0]) * by, middle + (this.x[1] - middle) * by);
};
Chart.prototype.zoom = function (a, b) {
  var span = Math.min(b - a, this.full[1] - this.full[0]);
  a = Math.min(Math.max(a, this.full[0]), this.full[1] - span);
  this.x = [a, a + Math.max(span, 1e-4 * (this.full[1] - this.full[0]))];
  this.canvas.dataset.range = this.x.map(function (v) { return digits(v, 6); }).join(' ');
  this.draw();
};
Chart.prototype.value = function (px) { return this.x[0] + (px - this.left) / this.wide * (this.x[1] - this.x[0]); };
Chart.prototype.draw = function () {
  var self = this, panels = this.provide(this.x[0], this.x[1]);
  var height = panels.reduce(function (s, p) { return s + p.height + 14; }, 34), s = sized(this.canvas, height), g = s.g, top = 8;
  this.left = 58; this.wide = s.w - this.left - 10;
  function X(v) { return self.left + (v - self.x[0]) / (self.x[1] - self.x[0]) * self.wide; }
  panels.forEach(function (p, n) {
    var low = p.low, high = p.high, Y = function (v) { return top + (high - v) / (high - low) * p.height; };
    g.strokeStyle = '#d5dbe1'; g.fillStyle = '#1f2933'; g.lineWidth = 1; g.textAlign = 'right'; g.textBaseline = 'middle';
    (p.ticks || ticks(low, high, Math.max(2, p.height / 45))).forEach(function (v) {
      g.beginPath(); g.moveTo(self.left, Y(v)); g.lineTo(self.left + self.wide, Y(v)); g.stroke();
      g.fillText(digits(v, 4), self.left - 5, Y(v));
    });
    g.textAlign = 'center'; g.textBaseline = 'top';
    ticks(self.x[0], self.x[1], Math.max(3, self.wide / 80)).forEach(function (v) {
      g.beginPath(); g.moveTo(X(v), top); g.lineTo(X(v), top + p.height); g.stroke();
      if (n === panels.length - 1) g.fillText(digits(v, 6), X(v), top + p.height + 4);
    });
    g.save(); g.translate(11, top + p.height / 2); g.rotate(-Math.PI / 2); g.textBaseline = 'middle'; g.fillText(p.label, 0, 0); g.restore();
    g.save(); g.beginPath(); g.rect(self.left, top, self.wide, p.height); g.clip();
    (p.marks || []).forEach(function (m) {
      g.strokeStyle = m.color; g.setLineDash([2, 3]); g.beginPath(); g.moveTo(X(m.x), top); g.lineTo(X(m.x), top + p.height); g.stroke(); g.setLineDash([]);
    });
    p.curves.forEach(function (c) {
      var pen = false;
      g.strokeStyle = c.color; g.lineWidth = c.width || 1.4; g.setLineDash(c.dash || []); g.beginPath();
      for (var i = 0; i < c.x.length; i++) {
        if (!Number.isFinite(c.y[i]) || (p.wraps && pen && Math.abs(c.y[i] - c.y[i - 1]) > 180)) pen = false;
        if (!Number.isFinite(c.y[i])) continue;
        if (pen) g.lineTo(X(c.x[i]), Y(c.y[i])); else g.moveTo(X(c.x[i]), Y(c.y[i]));
        pen = true;
      }
      g.stroke(); g.setLineDash([]);
    });
    (p.points || []).forEach(function (q) { g.fillStyle = q.color; g.fillText(q.text, X(q.x), Y(q.y) - 6); });
    if (self.drag !== null && self.drag !== undefined) {
      g.fillStyle = 'rgba(0,85,138,.12)'; g.fillRect(X(self.drag), top, X(self.cursor) - X(self.drag), p.height);
    }
    if (self.cursor !== null) { g.strokeStyle = '#1f2933'; g.lineWidth = 0.8; g.beginPath(); g.moveTo(X(self.cursor), top); g.lineTo(X(self.cursor), top + p.height); g.stroke(); }
    g.restore();
    g.strokeStyle = '#4b5762'; g.strokeRect(self.left, top, self.wide, p.height);
    top += p.height + 14;
  });
  g.textAlign = 'right'; g.textBaseline = 'alphabetic'; g.fillStyle = '#1f2933'; g.fillText('Frequency [Hz]', s.w - 10, s.h - 3);
  this.note.textContent = this.cursor === null ? 'Point at the figure to read it; drag to zoom, double click for the whole band.' : this.read(this.cursor);
};
function nearest(x, v) {
  var a = 0, b = x.length - 1;
  while (b - a > 1) { var m = (a + b) >> 1; if (x[m] < v) a = m; else b = m; }
  return v - x[a] < x[b] - v ? a : b;
}
/* FRFs: measured ones from their lines, models from their modes, for any pair. */
function frfs(host, data) {
  data.series.forEach(function (s) {
    if (s.kind === 'lines') {
      s.x = floats(s.hz); s.level = words16(s.level); s.phase = bytes(s.phase); s.coherence = s.coherence ? bytes(s.coherence) : null;
    } else { s.hz = floats(s.hz); s.damping = floats(s.damping); s.shapes = floats(s.shapes); }
    s.shown = true;
  });
  var chart = new Chart(host, 'Frequency response functions of the chosen pair', data.band, provide, read);
  function choice(keys) { return data.dofs.filter(function (d, i) { return data.series.some(function (s) { return s[keys].indexOf(i) >= 0; }); }); }
  var outs = choice('responses'), ins = choice('references');
  var response = chooser(chart.tools, 'Response', outs, changed), reference = chooser(chart.tools, 'Reference', ins, changed);
  chart.buttons();
  var legend = make('div', chart.tools, '', {'class': 'group'});
  data.series.forEach(function (s) {
    var l = make('label', legend), box = make('input', l, '', {type: 'checkbox'}), swatch = make('i', l, '', {'class': 'swatch'});
    swatch.style.borderTopColor = s.color; swatch.style.borderTopStyle = s.dash ? 'dashed' : 'solid';
    make('span', l, s.name);
    box.checked = true;
    box.addEventListener('change', function () { s.shown = box.checked; chart.draw(); });
    s.label = l;
  });
  var first = data.first || [0, 0];
  response.value = Math.max(0, outs.indexOf(data.dofs[first[0]])); reference.value = Math.max(0, ins.indexOf(data.dofs[first[1]]));
  function pair() { return [data.dofs.indexOf(outs[response.value]), data.dofs.indexOf(ins[reference.value])]; }
  function place(s) { var p = pair(), i = s.responses.indexOf(p[0]), j = s.references.indexOf(p[1]); return s.shown && i >= 0 && j >= 0 ? [i, j] : null; }
  function sum(s, ij, f) {
    var n = s.dofs, re = 0, im = 0, w = f * f;
    for (var r = 0; r < s.hz.length; r++) {
      var a = s.hz[r] * s.hz[r] - w, b = 2 * s.damping[r] * s.hz[r] * f, q = -w * s.shapes[r * n + ij[0]] * s.shapes[r * n + ij[1]] / (a * a + b * b);
      re += q * a; im -= q * b;
    }
    return {level: 10 * Math.log10(re * re + im * im), phase: Math.atan2(im, re) * 180 / Math.PI, coherence: null};
  }
  function line(s, ij, k) {
    var at = (ij[0] * s.references.length + ij[1]) * s.x.length + k, v = s.level[at], p = s.phase[at], c = s.coherence ? s.coherence[at] : 255;
    return {level: v === 65535 ? undefined : s.low + v * (s.high - s.low) / 65534, phase: p === 255 ? undefined : p * 360 / 254 - 180, coherence: c === 255 ? undefined : c / 254};
  }
  function grid(s, a, b) {
    var x = [], i;
    for (i = 0; i <= 900; i++) x.push(a + (b - a) * i / 900);
    for (var r = 0; r < s.hz.length; r++) if (s.hz[r] > a && s.hz[r] < b) for (i = -20; i <= 20; i++) x.push(s.hz[r] * (1 + s.damping[r] * i / 5));
    return x.filter(function (v) { return v >= a && v <= b && v > 0; }).sort(function (u, v) { return u - v; });
  }
  function provide(a, b) {
    var out = {level: [], phase: [], coherence: []}, low = Infinity, high = -Infinity, has = false;
    data.series.forEach(function (s) {
      var ij = place(s);
      s.label.className = ij || !s.shown ? '' : 'off';
      if (!ij) return;
      var x = [], got = {level: [], phase: [], coherence: []}, points = s.kind === 'lines' ? [] : grid(s, a, b);
      if (s.kind === 'lines') for (var k = 0; k < s.x.length; k++) if (s.x[k] >= a && s.x[k] <= b) points.push(k);
      points.forEach(function (p) {
        var v = s.kind === 'lines' ? line(s, ij, p) : sum(s, ij, p);
        x.push(s.kind === 'lines' ? s.x[p] : p);
        Object.keys(got).forEach(function (key) { got[key].push(v[key]); });
        if (Number.isFinite(v.level)) { low = Math.min(low, v.level); high = Math.max(high, v.level); }
      });
      Object.keys(out).forEach(function (key) {
        if (key === 'coherence' && !s.coherence) return;
        out[key].push({x: x, y: got[key], color: s.color, dash: s.dash, width: s.kind === 'lines' ? 1.2 : 1.6});
      });
      has = has || !!s.coherence;
    });
    if (!(high > low)) { low = -60; high = 0; }
    low = Math.max(low, high - 110);
    var marks = data.modes.map(function (m) { return {x: m.hz, color: '#4b5762'}; }), pad = 0.06 * (high - low);
    var panels = [{label: data.unit, height: 270, low: low - pad, high: high + pad, curves: out.level, marks: marks},
      {label: 'Phase [°]', height: 90, low: -185, high: 185, ticks: [-180, 0, 180], curves: out.phase, wraps: true}];
    if (has) panels.push({label: 'Coherence', height: 60, low: 0, high: 1.05, ticks: [0, 0.5, 1], curves: out.coherence});
    return panels;
  }
  function read(f) {
    var said = [digits(f, 5) + ' Hz'];
    data.series.forEach(function (s) {
      var ij = place(s);
      if (!ij) return;
      var v = s.kind === 'lines' ? line(s, ij, nearest(s.x, f)) : sum(s, ij, f);
      if (!Number.isFinite(v.level)) return;
      said.push(s.name + ': ' + digits(v.level, 4) + ' dB, ' + digits(Math.round(v.phase), 4) + '°' + (Number.isFinite(v.coherence) && v.coherence !== null ? ', coherence ' + digits(v.coherence, 3) : ''));
    });
    var close = data.modes.filter(function (m) { return Math.abs(m.hz - f) < 0.015 * (chart.x[1] - chart.x[0]); })
      .sort(function (a, b) { return Math.abs(a.hz - f) - Math.abs(b.hz - f); })[0];
    if (close) said.push(close.text);
    return said.join(' · ');
  }
  function changed() { chart.canvas.dataset.pair = outs[response.value] + ' from ' + ins[reference.value]; chart.draw(); }
  changed();
}
/* Poles of a stabilisation diagram. */
function poles(host, data) {
  var hz = floats(data.hz), order = words16(data.order), damping = floats(data.damping), status = bytes(data.status), shown = data.letters.map(function (l) { return l !== '×'; });
  var chart = new Chart(host, 'Poles by frequency and model order', data.band, provide, read), top = Math.max.apply(null, order) + 2;
  chart.buttons();
  data.letters.forEach(function (l, i) {
    var label = make('label', chart.tools), box = make('input', label, '', {type: 'checkbox'});
    make('span', label, l + ' ' + data.names[i]).style.color = data.colors[i];
    box.checked = shown[i];
    box.addEventListener('change', function () { shown[i] = box.checked; chart.draw(); });
  });
  function provide(a, b) {
    var points = [];
    for (var i = 0; i < hz.length; i++) if (hz[i] >= a && hz[i] <= b && shown[status[i]]) points.push({x: hz[i], y: order[i], text: data.letters[status[i]], color: data.colors[status[i]]});
    return [{label: 'Model order', height: 330, low: 0, high: top, curves: [], points: points, marks: data.modes.map(function (m) { return {x: m.hz, color: '#00558a'}; })}];
  }
  function read(f) {
    var best = -1, far = Infinity;
    for (var i = 0; i < hz.length; i++) { var d = Math.abs(hz[i] - f); if (shown[status[i]] && (d < far || (d === far && order[i] > order[best]))) { far = d; best = i; } }
    var close = data.modes.slice().sort(function (a, b) { return Math.abs(a.hz - f) - Math.abs(b.hz - f); })[0], said = [digits(f, 5) + ' Hz'];
    if (best >= 0) said.push('nearest pole: ' + digits(hz[best], 6) + ' Hz, damping ' + digits(100 * damping[best], 3) + ' %, order ' + order[best] + ', ' + data.names[status[best]]);
    if (close && Math.abs(close.hz - f) < 0.02 * (chart.x[1] - chart.x[0])) said.push(close.text);
    return said.join(' · ');
  }
  chart.draw();
}
/* Shapes that move: idle and operating beside each other, turned by dragging. */
function shapes(host, data) {
  var xyz = floats(data.xyz), n = xyz.length / 3, tools = make('div', host, '', {'class': 'tools'});
  var mode = chooser(tools, 'Mode', data.modes.map(function (m) { return m.name; }), pick);
  var play = button(tools, 'Play', 'Play or stop the motion', function () { moving = !moving; play.textContent = moving ? 'Stop' : 'Play'; if (moving) requestAnimationFrame(frame); });
  var size = make('input', make('label', tools, 'Size '), '', {type: 'range', min: 0, max: 100, value: 45});
  size.addEventListener('input', draw);
  var box = make('div', host), canvas = make('canvas', box, '', {role: 'img', 'aria-label': 'Mode shape on the structure'});
  var note = make('p', host, '', {'class': 'readout', 'aria-live': 'polite'});
  var moving = false, angle = 0, turn = [-0.6, 0.5], held = null, frames = 0, sides = [];
  canvas.addEventListener('pointerdown', function (e) { held = [e.clientX, e.clientY]; });
  canvas.addEventListener('pointermove', function (e) {
    if (!held) return;
    turn[0] += (e.clientX - held[0]) / 120; turn[1] += (e.clientY - held[1]) / 120;
    held = [e.clientX, e.clientY]; draw();
  });
  addEventListener('pointerup', function () { held = null; });
  addEventListener('resize', draw);
  function pick() {
    var m = data.modes[mode.value];
    sides = [['idle', m.idle, '#9a5b00'], ['operating', m.operating, '#00558a']].filter(function (s) { return s[1]; })
      .map(function (s) { return {name: s[0], color: s[2], re: floats(s[1].re), im: s[1].im ? floats(s[1].im) : null}; });
    note.textContent = m.text; canvas.dataset.mode = m.name;
    draw();
  }
  function frame() { if (!moving) return; angle += 0.09; frames += 1; canvas.dataset.frames = frames; draw(); requestAnimationFrame(frame); }
  function draw() {
    var stacked = box.clientWidth < 560, s = sized(canvas, stacked ? 260 * sides.length : 300), g = s.g;
    var w = stacked ? s.w : s.w / sides.length, h = stacked ? 260 : s.h, ca = Math.cos(turn[0]), sa = Math.sin(turn[0]), ce = Math.cos(turn[1]), se = Math.sin(turn[1]);
    function flat(x, y, z) { var u = ca * x - sa * y, v = sa * x + ca * y; return [u, -(ce * z + se * v)]; }
    sides.forEach(function (side, k) {
      var x0 = (stacked ? 0 : k * w) + w / 2, y0 = (stacked ? k * h : 0) + h / 2 + 8, scale = 0.62 * Math.min(w, 1.6 * h), much = 0.3 * size.value / 45;
      var c = Math.cos(angle) * much, d = Math.sin(angle) * much, rest = [], now = [];
      for (var i = 0; i < n; i++) {
        var p = [0, 1, 2].map(function (a) { return xyz[3 * i + a]; });
        var q = p.map(function (v, a) { return v + c * side.re[3 * i + a] - (side.im ? d * side.im[3 * i + a] : 0); });
        rest.push(flat(p[0], p[1], p[2])); now.push(flat(q[0], q[1], q[2]));
      }
      function path(points, list) { list.forEach(function (e) { e.forEach(function (i, m) { var p = points[i]; if (m) g.lineTo(x0 + scale * p[0], y0 + scale * p[1]); else g.moveTo(x0 + scale * p[0], y0 + scale * p[1]); }); }); }
      g.lineWidth = 1; g.strokeStyle = '#b3bcc5'; g.beginPath(); path(rest, data.edges); g.stroke();
      g.fillStyle = side.color; g.globalAlpha = 0.12; data.faces.forEach(function (f) { g.beginPath(); path(now, [f]); g.fill(); }); g.globalAlpha = 1;
      g.lineWidth = 1.8; g.strokeStyle = side.color; g.beginPath(); path(now, data.edges); g.stroke();
      data.measured.forEach(function (i) { g.beginPath(); g.arc(x0 + scale * now[i][0], y0 + scale * now[i][1], 3, 0, 7); g.fill(); });
      g.textAlign = 'center'; g.textBaseline = 'top'; g.fillText(side.name, x0, y0 - h / 2 - 4);
    });
  }
  pick();
}
/* Tables sort by a click on a heading. */
function sortable(table) {
  var body = table.tBodies[0], heads = table.tHead ? Array.from(table.tHead.rows[0].cells) : [];
  if (!body || body.rows.length < 3) return;
  function key(row, k) {
    var text = row.cells[k] ? row.cells[k].textContent.trim() : '', value = parseFloat(text.replace(/−/g, '-').replace(/^< /, ''));
    return Number.isFinite(value) ? value : text.toLowerCase();
  }
  heads.forEach(function (head, k) {
    if (!head.textContent) return;
    var b = make('button', null, head.textContent, {type: 'button', 'class': 'sort'});
    head.textContent = ''; head.appendChild(b);
    b.addEventListener('click', function () {
      var up = head.getAttribute('aria-sort') !== 'ascending', rows = Array.from(body.rows);
      heads.forEach(function (h) { h.removeAttribute('aria-sort'); });
      head.setAttribute('aria-sort', up ? 'ascending' : 'descending');
      rows.sort(function (r, s) {
        var a = key(r, k), c = key(s, k), number = typeof a === 'number';
        if (number !== (typeof c === 'number')) return number ? -1 : 1;
        return (a < c ? -1 : a > c ? 1 : 0) * (up ? 1 : -1);
      });
      rows.forEach(function (r) { body.appendChild(r); });
    });
  });
}
document.querySelectorAll('table').forEach(sortable);
/* Data of a figure: packed in the page, unpacked on a click. */
document.querySelectorAll('a.csv').forEach(function (a) {
  if (!window.DecompressionStream) return;
  a.addEventListener('click', function (e) {
    if (a.href.indexOf('data:') !== 0) return;
    e.preventDefault();
    new Response(new Blob([bytes(a.href.split(',')[1])]).stream().pipeThrough(new DecompressionStream('gzip'))).blob().then(function (made) {
      a.href = URL.createObjectURL(new Blob([made], {type: 'text/csv'}));
      a.download = a.download.replace('.gz', '');
      a.click();
    });
  });
});
var kinds = {frfs: frfs, poles: poles, shapes: shapes};
function start(host) {
  var data = host.querySelector('pre');
  if (!data || host.dataset.live) return;
  host.dataset.live = 'on'; host.hidden = false;
  kinds[host.dataset.kind](host, JSON.parse(data.textContent));
}
/* What lies in a folded part has no width before it is opened. */
document.querySelectorAll('.live').forEach(function (host) {
  var folded = host.closest('details:not([open])');
  if (folded) folded.addEventListener('toggle', function () { start(host); }); else start(host);
});
document.documentElement.dataset.live = 'on';
})();
