"use strict";
// Three planes on plain canvases with a slider each: for browsers without WebGL.
G3R.PLANES = [
  { name: "axial", normal: 2, across: 0, up: 1, sides: ["R", "L", "A", "P"] },
  { name: "coronal", normal: 1, across: 0, up: 2, sides: ["R", "L", "S", "I"] },
  { name: "sagittal", normal: 0, across: 1, up: 2, sides: ["A", "P", "S", "I"] },
];

G3R.plainViewer = async function (host, layers, told) {
  var images = {};
  for (var layer of layers) images[layer.name] = await G3R.readImage(layer.data);
  var volume = images.volume, colors = G3R.bytes(G3R.data.colors), views = [], shown = null;
  var base = layers.find(function (one) { return one.name === "volume"; });
  var state = { low: base.low, high: base.high, opacity: 0.7, marks: {} };
  var at = volume.shape.map(function (n) { return Math.floor(n / 2); });
  var index = function (place) { return place[0] + volume.shape[0] * (place[1] + volume.shape[1] * place[2]); };
  var value = function (name, where) { var one = images[name]; return one.slope * one.values[where] + one.zero; };

  function pixel(where) {
    var color, share = 255 * (value("volume", where) - state.low) / (state.high - state.low);
    color = [share, share, share];
    if (shown && (shown.kind === "grey" || images[shown.name].values[where] > 0)) {
      var part = (value(shown.name, where) - shown.low) / (shown.high - shown.low);
      var entry = 3 * Math.round(255 * Math.min(Math.max(part, 0), 1));
      var over = shown.kind === "grey" ? [255 * part, 255 * part, 255 * part] : colors.subarray(entry, entry + 3);
      var weight = shown.kind === "grey" ? 1 : state.opacity;
      color = color.map(function (one, n) { return Math.min(Math.max(one, 0), 255) * (1 - weight) + over[n] * weight; });
    }
    for (var name in state.marks) {
      if (!state.marks[name] || !images[name].values[where]) continue;
      var mark = G3R.MARK_COLORS[name], alpha = mark[3] / 255;
      color = color.map(function (one, n) { return Math.min(Math.max(one, 0), 255) * (1 - alpha) + mark[n] * alpha; });
    }
    return color;
  }

  function draw(view) {
    var plane = view.plane, width = volume.shape[plane.across], height = volume.shape[plane.up];
    var context = view.canvas.getContext("2d"), picture = context.createImageData(width, height), place = at.slice();
    for (var row = 0; row < height; row++) {
      place[plane.up] = height - 1 - row;
      for (var column = 0; column < width; column++) {
        place[plane.across] = width - 1 - column; // the patient's right, and the front, come to the left
        var color = pixel(index(place)), n = 4 * (row * width + column);
        if (column === width - 1 - at[plane.across] || row === height - 1 - at[plane.up])
          color = color.map(function (one, c) { return 0.65 * Math.min(Math.max(one, 0), 255) + 0.35 * [60, 200, 120][c]; });
        picture.data[n] = color[0]; picture.data[n + 1] = color[1]; picture.data[n + 2] = color[2];
        picture.data[n + 3] = 255;
      }
    }
    context.putImageData(picture, 0, 0);
    view.slider.value = at[plane.normal];
  }

  function drawAll() {
    views.forEach(draw);
    var where = index(at), world = at.map(function (n, axis) { return volume.origin[axis] + n * volume.spacing[axis]; });
    told(world, layers.filter(function (one) { return one.kind !== "mark"; }).map(function (one) {
      return [one.title, value(one.name, where)];
    }));
  }

  function makeView(plane) {
    var box = document.createElement("div"), frame = document.createElement("div");
    var canvas = document.createElement("canvas"), slider = document.createElement("input");
    box.className = "plane"; frame.className = "frame"; slider.type = "range";
    canvas.width = volume.shape[plane.across]; canvas.height = volume.shape[plane.up];
    slider.max = volume.shape[plane.normal] - 1; slider.setAttribute("aria-label", plane.name + " section");
    slider.addEventListener("input", function () { at[plane.normal] = Number(slider.value); drawAll(); });
    var move = function (event) {
      var area = canvas.getBoundingClientRect(), scale = Math.min(area.width / canvas.width, area.height / canvas.height);
      var column = (event.clientX - area.left - (area.width - scale * canvas.width) / 2) / scale;
      var row = (event.clientY - area.top - (area.height - scale * canvas.height) / 2) / scale;
      var inside = function (n, count) { return Math.min(Math.max(Math.floor(n), 0), count - 1); };
      at[plane.across] = canvas.width - 1 - inside(column, canvas.width);
      at[plane.up] = canvas.height - 1 - inside(row, canvas.height);
      drawAll();
    };
    canvas.addEventListener("pointerdown", move);
    canvas.addEventListener("pointermove", function (event) { if (event.buttons) move(event); });
    frame.append(canvas);
    ["left", "right", "top", "bottom"].forEach(function (side, n) {
      var letter = document.createElement("span");
      letter.className = "side " + side; letter.textContent = plane.sides[n];
      frame.append(letter);
    });
    box.append(frame, slider, document.createElement("br"), plane.name);
    host.append(box);
    return { plane: plane, canvas: canvas, slider: slider };
  }

  views = G3R.PLANES.map(makeView);
  drawAll();
  return {
    show: function (layer) { shown = layer; drawAll(); },
    mark: function (name, on) { state.marks[name] = on; drawAll(); },
    window: function (low, high) { state.low = low; state.high = high; drawAll(); },
    opacity: function (share) { state.opacity = share; drawAll(); },
  };
};
