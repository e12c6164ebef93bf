"use strict";
// Buttons and sliders over whichever viewer works here; the static pictures stay where none does.
(async function () {
  var get = function (id) { return document.getElementById(id); };
  var layers = G3R.data.layers, host = get("viewer"), viewer = null;
  var base = layers.find(function (one) { return one.name === "volume"; });
  var figure = function (value) { return Number(value.toPrecision(3)).toString(); };
  var told = function (world, values) {
    var place = Array.from(world).slice(0, 3).map(function (mm) { return mm.toFixed(1); }).join(", ");
    get("readout").textContent = "at " + place + " mm: " + values.map(function (one) {
      return one[0] + " " + figure(one[1]);
    }).join(", ");
  };

  async function started(kind, area, make) {
    area.hidden = false;
    try {
      viewer = await make(area, layers, told);
      host.dataset.viewer = kind;
      get("static").hidden = true;
    } catch (error) {
      area.hidden = true;
    }
  }
  if (G3R.hasWebgl()) await started("webgl", get("webgl"), G3R.webglViewer);
  if (!viewer) await started("plain", get("planes"), G3R.plainViewer);
  if (!viewer) {
    get("viewer-note").textContent = "This browser cannot show the images; the pictures are central sections. " +
      "The patient's right is on the left.";
    return;
  }

  function choose(layer, button) {
    for (var other of get("overlays").children) other.setAttribute("aria-checked", String(other === button));
    viewer.show(layer.name === "volume" ? null : layer);
    get("caption").textContent = layer.caption[0].toUpperCase() + layer.caption.slice(1) + ".";
    get("legend").hidden = layer.kind !== "map";
    get("legend-low").textContent = figure(layer.low);
    get("legend-high").textContent = figure(layer.high) + (layer.high === 1 ? "" : " and more");
  }
  function button(group, layer, state) {
    var one = document.createElement("button");
    one.type = "button"; one.textContent = layer.title; one.dataset.layer = layer.name;
    one.setAttribute(state, "false");
    group.append(one);
    return one;
  }
  layers.forEach(function (layer) {
    if (layer.kind === "mark") {
      var mark = button(get("marks"), layer, "aria-pressed");
      mark.title = layer.caption;
      var set = function (on) { mark.setAttribute("aria-pressed", String(on)); viewer.mark(layer.name, on); };
      mark.addEventListener("click", function () { set(mark.getAttribute("aria-pressed") !== "true"); });
      if (layer.name === "unseen") set(true);
    } else {
      var one = button(get("overlays"), layer, "aria-checked");
      one.setAttribute("role", "radio");
      one.addEventListener("click", function () { choose(layer, one); });
      if (layer.name === "volume") choose(layer, one);
    }
  });

  var colors = G3R.bytes(G3R.data.colors), stops = [];
  for (var n = 0; n < 256; n += 15) stops.push("rgb(" + colors.subarray(3 * n, 3 * n + 3).join(",") + ")");
  get("legend-bar").style.background = "linear-gradient(90deg," + stops.join(",") + ")";

  var span = base.high - base.low;
  [["low", base.low], ["high", base.high]].forEach(function (end) {
    var slider = get(end[0]);
    slider.min = base.low; slider.max = base.high + 0.5 * span; slider.step = span / 100; slider.value = end[1];
    slider.addEventListener("input", function () {
      var low = Number(get("low").value), high = Math.max(Number(get("high").value), low + span / 50);
      viewer.window(low, high);
    });
  });
  get("opacity").addEventListener("input", function () { viewer.opacity(Number(get("opacity").value)); });
  get("controls").hidden = false;
  host.dataset.ready = "true";
})();
