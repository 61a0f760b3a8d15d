"use strict";
// Draws every figure of the page from its data: panels of lines, points, ribbons and bands, axes
// with units. A panel that may be zoomed shows least and greatest value of each pixel column, so
// that a long record loses no peak.
(() => {
  const SVG = "http://www.w3.org/2000/svg";
  const EDGE = { top: 20, right: 10, bottom: 38 };
  const WIDE = 1e-12;

  const element = (name, attributes, parent, text) => {
    const made = document.createElementNS(SVG, name);
    for (const key in attributes) made.setAttribute(key, attributes[key]);
    if (text !== undefined) made.textContent = text;
    if (parent) parent.appendChild(made);
    return made;
  };

  const data = JSON.parse(document.getElementById("data").textContent);

  // -- arrays: a list; evenly spaced; base64 of float32, or of int16 (scaled, -32768 for none) ----
  const kept = new Map();
  const bytes = (text) => {
    const raw = atob(text), found = new Uint8Array(raw.length);
    for (let k = 0; k < raw.length; k++) found[k] = raw.charCodeAt(k);
    return found.buffer;
  };
  const decode = (number) => {
    if (kept.has(number)) return kept.get(number);
    const stored = data.arrays[number];
    let found;
    if (Array.isArray(stored)) {
      found = Float64Array.from(stored, (v) => (v === null ? NaN : v));
    } else if ("step" in stored) {
      found = new Float64Array(stored.n);
      for (let k = 0; k < stored.n; k++) found[k] = stored.start + k * stored.step;
    } else if ("i16" in stored) {
      const raw = new Int16Array(bytes(stored.i16));
      found = new Float64Array(raw.length);
      for (let k = 0; k < raw.length; k++)
        found[k] = raw[k] === -32768 ? NaN : raw[k] * stored.scale;
    } else found = new Float32Array(bytes(stored.f32));
    kept.set(number, found);
    return found;
  };

  // -- axes -----------------------------------------------------------------------------------------
  const ticks = (low, high, count) => {
    let found = evenly(low, high, count);
    for (let more = count + 1; found.at.length < 3 && more < count + 8; more++)
      found = evenly(low, high, more);
    return found;
  };
  const evenly = (low, high, count) => {
    const raw = (high - low) / count, size = 10 ** Math.floor(Math.log10(raw));
    const step = size * [1, 2, 5, 10].find((f) => f * size >= raw * (1 - 1e-9));
    const found = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++)
      found.push(k * step);
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    return { at: found, text: (v) => minus(v.toFixed(digits)) };
  };
  const minus = (text) => (Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−"));
  const raised = (n) => [...String(n)].map((c) => "⁰¹²³⁴⁵⁶⁷⁸⁹"[c] || "⁻").join("");
  const decades = (low, high, count) => {
    const a = Math.ceil(low - 1e-9), b = Math.floor(high + 1e-9), found = [];
    const every = Math.max(1, Math.ceil((b - a + 1) / count));
    for (let k = a; k <= b; k += every) found.push(k);
    // Three decades or more, or no room for what lies between: powers of ten alone.
    const crowded = found.length > 1 && 3 * (high - low) > 2 * count;
    if (found.length > 2 || crowded) return { at: found, text: (v) => "10" + raised(v) };
    const between = []; // less than two decades: 1, 2 and 5 of each
    for (let k = Math.floor(low); k <= high; k++)
      for (const m of [1, 2, 5]) {
        const at = k + Math.log10(m);
        if (at >= low - 1e-9 && at <= high + 1e-9) between.push(at);
      }
    const text = (v) => {
      const k = Math.floor(v + 1e-9), m = Math.round(10 ** (v - k));
      if (k >= -3 && k <= 4) return minus(String(Number((m * 10 ** k).toPrecision(2))));
      return (m === 1 ? "" : m + "·") + "10" + raised(k);
    };
    return { at: between, text };
  };
  // Powers of ten go to the label, so that tick texts stay short.
  const power = (axis, low, high) => {
    const size = Math.max(Math.abs(low), Math.abs(high));
    if (axis.log || !(size > 0) || (size >= 1e-2 && size < 1e5)) return 0;
    return 3 * Math.floor(Math.log10(size) / 3);
  };
  const labelled = (axis, exponent) => {
    const unit = axis.unit === "1" ? "" : axis.unit;
    const factor = exponent ? "10" + raised(exponent) + (unit ? " " : "") : "";
    const said = factor + unit, own = said.startsWith("[") && said.indexOf("]") === said.length - 1;
    return axis.label + (said ? (own ? " " + said : ` (${said})`) : "");
  };

  // -- one panel --------------------------------------------------------------------------------------
  const draw = (panel, svg, width, range) => {
    svg.replaceChildren();
    const spec = panel.spec, dots = spec.categories;
    const height = spec.square ? width - 16 : panel.height || 170;
    const logX = spec.x.log ? Math.log10 : Number, logY = spec.y.log ? Math.log10 : Number;
    let [x0, x1] = (range || spec.x.range).map(logX), [y0, y1] = spec.y.range.map(logY);
    if (x1 - x0 < WIDE * Math.abs(x1)) x1 = x0 + 1;
    if (y1 - y0 < WIDE * Math.abs(y1)) y1 = y0 + 1;
    const ex = power(spec.x, x0, x1), ey = power(spec.y, y0, y1);
    const rows = Math.max(3, Math.floor((height - EDGE.top - EDGE.bottom) / 28));
    const ty = dots
      ? { at: dots.map((_, k) => k), text: (k) => dots[k] }
      : spec.y.log ? decades(y0, y1, rows) : ticks(y0 / 10 ** ey, y1 / 10 ** ey, rows);
    const longest = Math.max(...ty.at.map((v) => ty.text(v).length), 1);
    const left = Math.max(64, (dots ? 12 : 28) + 6.6 * longest), right = width - EDGE.right;
    const bottom = height - EDGE.bottom, top = EDGE.top;
    const px = (v) => left + ((logX(v) - x0) / (x1 - x0)) * (right - left);
    const py = (v) => bottom - ((logY(v) - y0) / (y1 - y0)) * (bottom - top);
    const columns = Math.max(2, Math.floor((right - left) / 70));
    const tx = spec.x.log ? decades(x0, x1, columns) : ticks(x0 / 10 ** ex, x1 / 10 ** ex, columns);
    svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    svg.setAttribute("aria-label",
      `${panel.title}: ${labelled(spec.y, 0)} over ${labelled(spec.x, 0)}`);
    const clip = "clip-" + panel.id;
    const inside = element("clipPath", { id: clip }, element("defs", {}, svg));
    element("rect", { x: left, y: top, width: right - left, height: bottom - top }, inside);
    const field = element("g", { "clip-path": `url(#${clip})` }, svg);
    for (const band of spec.bands || []) {
      const [high, low] = [py(band.high), py(band.low)];
      element("rect", { class: "band", x: left, width: right - left, y: high, height: low - high }, field);
    }
    for (const v of ty.at) {
      const y = dots ? py(v) : bottom - ((v * 10 ** ey - y0) / (y1 - y0)) * (bottom - top);
      element("line", { class: "grid", x1: left, x2: right, y1: y, y2: y }, svg);
      element("text", { x: left - 6, y: y + 4, "text-anchor": "end" }, svg, ty.text(v));
    }
    for (const v of tx.at) {
      const x = left + ((v * 10 ** ex - x0) / (x1 - x0)) * (right - left);
      element("line", { class: "grid", x1: x, x2: x, y1: top, y2: bottom }, svg);
      element("text", { x, y: bottom + 15, "text-anchor": "middle" }, svg, tx.text(v));
    }
    if (!dots && !spec.y.log && y0 < 0 && y1 > 0)
      element("line", { class: "zero", x1: left, x2: right, y1: py(0), y2: py(0) }, svg);
    for (const mark of spec.marks || []) {
      element("line", { class: "mark", x1: px(mark.x), x2: px(mark.x), y1: top, y2: bottom }, field);
      element("text", { x: px(mark.x) + 4, y: top + 11 }, field, mark.name);
    }
    svg.appendChild(field);
    for (const one of spec.series) series(one, field, px, py, left, right, (v) => logX(v) >= x0, (v) => logX(v) <= x1);
    for (const band of spec.bands || [])
      for (const edge of [band.low, band.high])
        element("line", { class: "edge", x1: left, x2: right, y1: py(edge), y2: py(edge) }, field);
    element("rect", { class: "frame", x: left, y: top, width: right - left, height: bottom - top }, svg);
    element("text", { class: "title", x: left, y: 13 }, svg, panel.title);
    let beside = right;
    for (const one of spec.series.filter((s) => s.name).reverse()) {
      element("text", { class: "key " + one.look, x: beside, y: 13, "text-anchor": "end" }, svg, "● " + one.name);
      beside -= 6.4 * one.name.length + 24;
    }
    element("text", { class: "label x", x: (left + right) / 2, y: height - 5, "text-anchor": "middle",
      "data-unit": spec.x.unit }, svg, labelled(spec.x, ex));
    if (!dots)
      element("text", { class: "label y", x: -(top + bottom) / 2, y: 11, "text-anchor": "middle",
        transform: "rotate(-90)", "data-unit": spec.y.unit }, svg, labelled(spec.y, ey));
    const within = (v) => logX(v) >= x0 && logX(v) <= x1;
    return { left, right, top, bottom, x0, x1, px, py, within };
  };

  // -- values: the point nearest to the pointer, or stepped to by keys ---------------------------------
  const curves = (p) => p.spec.series.filter((s) => s.y !== undefined && !s.bare && s.look !== "rim" && s.look !== "band");
  const say = (p, one, k) => {
    const x = decode(one.x)[k], y = decode(one.y)[k], dots = p.spec.categories;
    const units = (u) => (u === "1" ? "" : " " + u);
    const short = (v) => minus(String(Number(v.toPrecision(5))));
    const ends = one.low === undefined ? ""
      : ` (${short(decode(one.low)[k])} to ${short(decode(one.high)[k])})`;
    const first = dots ? dots[Math.round(y)] : short(x) + units(p.spec.x.unit);
    const second = dots ? short(x) + ends + units(p.spec.x.unit) : short(y) + ends + units(p.spec.y.unit);
    return `${one.name ? one.name + ": " : ""}${first}; ${second}`;
  };
  const point = (p, one, k) => {
    p.svg.querySelectorAll(".at, .value").forEach((e) => e.remove());
    if (one === null) return;
    p.now = [one, k];
    const x = p.at.px(decode(one.x)[k]), y = p.at.py(decode(one.y)[k]);
    element("circle", { class: "at", cx: x, cy: y, r: 5 }, p.svg);
    const end = x > (p.at.left + p.at.right) / 2;
    element("text", { class: "value", x: x + (end ? -9 : 9), y: Math.max(y - 8, p.at.top + 11),
      "text-anchor": end ? "end" : "start" }, p.svg, say(p, one, k));
  };
  const inspected = (p, zoom) => {
    p.svg.setAttribute("tabindex", "0");
    p.svg.addEventListener("pointermove", (e) => {
      const box = p.svg.getBoundingClientRect(), scale = p.svg.viewBox.baseVal.width / box.width;
      const [mx, my] = [(e.clientX - box.left) * scale, (e.clientY - box.top) * scale];
      let best = [null, 0], least = Infinity;
      for (const one of curves(p)) {
        const x = decode(one.x), y = decode(one.y), step = Math.max(1, Math.floor(x.length / 20000));
        for (let k = 0; k < x.length; k += step) {
          if (!Number.isFinite(y[k]) || !p.at.within(x[k])) continue;
          const dx = p.at.px(x[k]) - mx, dy = p.at.py(y[k]) - my, far = dx * dx + 0.15 * dy * dy;
          if (far < least) { least = far; best = [one, k]; }
        }
      }
      point(p, ...best);
    });
    p.svg.addEventListener("pointerleave", () => point(p, null));
    p.svg.addEventListener("blur", () => point(p, null));
    p.svg.addEventListener("keydown", (e) => {
      const move = zoom ? { ",": -1, ".": 1 }[e.key] : { ArrowLeft: -1, ArrowRight: 1 }[e.key];
      const first = curves(p)[0];
      if (!move || !first) return;
      const [one, k] = p.now || [first, -1], n = decode(one.x).length;
      let next = k + move;
      while (next >= 0 && next < n && !Number.isFinite(decode(one.y)[next])) next += move;
      if (next >= 0 && next < n) point(p, one, next);
      e.preventDefault();
    });
  };

  const series = (one, parent, px, py, left, right, afterLow, beforeHigh) => {
    const x = decode(one.x), n = x.length;
    if (one.kind === "ribbon") {
      const low = decode(one.low), high = decode(one.high), there = [], back = [];
      const step = Math.max(1, Math.floor(n / 2000));
      for (let k = 0; k < n; k += step) {
        if (!Number.isFinite(low[k])) continue;
        there.push(`${px(x[k]).toFixed(1)} ${py(high[k]).toFixed(1)}`);
        back.unshift(`${px(x[k]).toFixed(1)} ${py(low[k]).toFixed(1)}`);
      }
      if (there.length) element("path", { class: "ribbon " + one.look, d: "M" + there.concat(back).join("L") + "Z" }, parent);
      return;
    }
    const y = decode(one.y);
    if (one.kind === "spans" || one.kind === "bars") {
      const low = decode(one.low), high = decode(one.high), flat = one.kind === "spans";
      for (let k = 0; k < n; k++) {
        if (!Number.isFinite(x[k]) || !Number.isFinite(y[k])) continue;
        const [x1, x2] = flat ? [px(low[k]), px(high[k])] : [px(x[k]), px(x[k])];
        const [y1, y2] = flat ? [py(y[k]), py(y[k])] : [py(low[k]), py(high[k])];
        element("line", { class: "line " + one.look, x1, x2, y1, y2 }, parent);
        element("circle", { class: "dot " + one.look, cx: px(x[k]).toFixed(1), cy: py(y[k]).toFixed(1), r: 3.4 }, parent);
      }
      return;
    }
    if (one.kind === "dots" || one.kind === "points") {
      if (n <= 1500) {
        for (let k = 0; k < n; k++)
          if (Number.isFinite(y[k]))
            element("circle", { class: (one.kind === "dots" ? "dot " : "point ") + one.look,
              cx: px(x[k]).toFixed(1), cy: py(y[k]).toFixed(1), r: one.kind === "dots" ? 4.2 : 2 }, parent);
        return;
      }
    }
    if (one.kind === "stems") {
      let d = "";
      for (let k = 0; k < n; k++)
        if (Number.isFinite(y[k])) d += `M${px(x[k]).toFixed(1)} ${py(0).toFixed(1)}V${py(y[k]).toFixed(1)}`;
      element("path", { class: "line " + one.look, d }, parent);
      return;
    }
    let first = 0, last = n - 1;
    while (first < n - 1 && !afterLow(x[first + 1])) first++;
    while (last > 0 && !beforeHigh(x[last - 1])) last--;
    element("path", { class: "line " + one.look, d: path(x, y, first, last, px, py, right - left) }, parent);
    if (last - first < (right - left) / 6 && !one.bare)
      for (let k = first; k <= last; k++)
        if (Number.isFinite(y[k]))
          element("circle", { class: "point " + one.look, cx: px(x[k]).toFixed(1), cy: py(y[k]).toFixed(1), r: 1.8 }, parent);
  };

  const path = (x, y, first, last, px, py, width) => {
    let d = "", pen = false;
    if (last - first <= 3 * width) {
      for (let k = first; k <= last; k++) {
        if (!Number.isFinite(y[k])) { pen = false; continue; }
        d += `${pen ? "L" : "M"}${px(x[k]).toFixed(1)} ${py(y[k]).toFixed(1)}`;
        pen = true;
      }
      return d;
    }
    let column = NaN, low = Infinity, high = -Infinity;
    const close = () => {
      if (high >= low) {
        d += `${pen ? "L" : "M"}${column} ${py(high).toFixed(1)}V${py(low).toFixed(1)}`;
        pen = true;
      }
    };
    for (let k = first; k <= last; k++) {
      if (!Number.isFinite(y[k])) { close(); pen = false; low = Infinity; high = -Infinity; continue; }
      const at = Math.round(px(x[k]));
      if (at !== column) { close(); column = at; low = Infinity; high = -Infinity; }
      if (y[k] < low) low = y[k];
      if (y[k] > high) high = y[k];
    }
    close();
    return d;
  };

  // -- one figure: panels that share their range ---------------------------------------------------
  const show = (figure, number) => {
    const holder = document.getElementById(figure.id), box = holder.querySelector(".panels");
    const panels = figure.panels.map((spec, k) => {
      const svg = element("svg", { role: "img" }, box);
      return { spec, svg, title: spec.title, height: spec.height, id: `${number}-${k}`, range: null };
    });
    const width = () => (panels.length ? panels[0].svg.getBoundingClientRect().width : 0);
    const redraw = (size) => {
      if (!size) return; // folded away: drawn when it is opened
      for (const p of panels) p.at = draw(p, p.svg, size, p.range);
    };
    for (const p of panels) inspected(p, figure.zoom);
    if (figure.zoom) zoomable(holder, panels, () => redraw(width()));
    redraw(width());
    let known = width();
    new ResizeObserver(() => {
      const now = width();
      if (now && Math.abs(now - known) > 2) redraw((known = now));
    }).observe(box);
    return (printing) => redraw(printing ? (figure.two ? 340 : 690) : width());
  };

  const zoomable = (holder, panels, redraw) => {
    const readout = holder.querySelector("output");
    const full = panels[0].spec.x.range, unit = panels[0].spec.x.unit;
    const current = () => panels[0].range || full;
    const set = (low, high) => {
      const a = Math.max(full[0], low), b = Math.min(full[1], high);
      const whole = b - a >= (full[1] - full[0]) * 0.999;
      if (!whole && b - a < (full[1] - full[0]) * 1e-6) return;
      for (const p of panels) p.range = whole ? null : [a, b];
      redraw();
    };
    const by = (factor) => {
      const [a, b] = current(), middle = (a + b) / 2, half = ((b - a) / 2) * factor;
      set(middle - half, middle + half);
    };
    const move = (share) => {
      const [a, b] = current(), step = Math.min(Math.max(share * (b - a), full[0] - a), full[1] - b);
      set(a + step, b + step);
    };
    const actions = { in: () => by(0.5), out: () => by(2), left: () => move(-0.4),
      right: () => move(0.4), all: () => set(...full) };
    for (const button of holder.querySelectorAll("button"))
      button.addEventListener("click", actions[button.dataset.action]);
    const keys = { "+": "in", "=": "in", "-": "out", ArrowLeft: "left", ArrowRight: "right", 0: "all" };
    for (const p of panels) {
      p.svg.setAttribute("tabindex", "0");
      p.svg.addEventListener("keydown", (e) => {
        if (keys[e.key] && !e.ctrlKey && !e.metaKey) { actions[keys[e.key]](); e.preventDefault(); }
      });
      p.svg.addEventListener("dblclick", actions.all);
      const place = (e) => {
        const scale = p.svg.viewBox.baseVal.width / p.svg.getBoundingClientRect().width;
        const x = (e.clientX - p.svg.getBoundingClientRect().left) * scale;
        return Math.min(Math.max(x, p.at.left), p.at.right);
      };
      const value = (x) => p.at.x0 + ((x - p.at.left) / (p.at.right - p.at.left)) * (p.at.x1 - p.at.x0);
      let from = null, shade = null;
      p.svg.addEventListener("pointerdown", (e) => {
        if (e.button) return;
        from = place(e);
        shade = element("rect", { class: "select", x: from, width: 0, y: p.at.top, height: p.at.bottom - p.at.top }, p.svg);
        p.svg.setPointerCapture(e.pointerId);
      });
      p.svg.addEventListener("pointermove", (e) => {
        const x = place(e);
        if (from !== null) {
          shade.setAttribute("x", Math.min(x, from));
          shade.setAttribute("width", Math.abs(x - from));
        }
        readout.textContent = nearest(p.spec, value(x), unit);
      });
      const end = (e) => {
        if (from === null) return;
        const [a, b] = [from, place(e)].sort((m, n) => m - n);
        from = null;
        shade.remove();
        if (e.type === "pointerup" && b - a > 5) set(value(a), value(b));
      };
      p.svg.addEventListener("pointerup", end);
      p.svg.addEventListener("pointercancel", end);
    }
  };

  const nearest = (spec, x, unit) => {
    const one = spec.series.find((s) => s.y !== undefined), at = decode(one.x);
    let low = 0, high = at.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (at[middle] < x) low = middle; else high = middle;
    }
    const k = x - at[low] < at[high] - x ? low : high, y = decode(one.y)[k];
    const units = (u) => (u === "1" ? "" : " " + u);
    return `${spec.title}: ${Number(at[k].toPrecision(7))}${units(unit)}, ${minus(String(Number(y.toPrecision(4))))}${units(spec.y.unit)}`;
  };

  const all = data.figures.map(show);
  const everything = (printing) => all.forEach((redraw) => redraw(printing));
  addEventListener("beforeprint", () => {
    document.querySelectorAll("details").forEach((d) => { d.dataset.was = d.open ? "1" : ""; d.open = true; });
    everything(true);
  });
  addEventListener("afterprint", () => {
    document.querySelectorAll("details").forEach((d) => { d.open = d.dataset.was === "1"; });
    everything(false);
  });
  document.documentElement.dataset.drawn = String(Math.round(performance.now()));
})();
