"use strict";
// The same on NiiVue. Everything is loaded once; a button changes what is opaque.
G3R.hasWebgl = function () {
  try {
    return Boolean(document.createElement("canvas").getContext("webgl2"));
  } catch (error) {
    return false;
  }
};

G3R.colormap = function (name, viewer) {
  var colors = G3R.bytes(G3R.data.colors), map = { R: [], G: [], B: [], A: [], I: [] };
  var mark = G3R.MARK_COLORS[name];
  if (mark) {
    map = { R: [mark[0], mark[0]], G: [mark[1], mark[1]], B: [mark[2], mark[2]], A: [0, 255], I: [0, 255] };
  } else {
    for (var n = 0; n < 256; n += 5) { // what is exactly zero lies outside the head and stays clear
      map.R.push(colors[3 * n]); map.G.push(colors[3 * n + 1]); map.B.push(colors[3 * n + 2]);
      map.A.push(n ? 255 : 0); map.I.push(n);
    }
  }
  viewer.addColormap("g3r-" + name, map);
  return "g3r-" + name;
};

G3R.webglViewer = async function (host, layers, told) {
  var viewer = new niivue.Niivue({
    logLevel: "error", loadingText: "", dragAndDropEnabled: false, isRadiologicalConvention: true, sagittalNoseLeft: true,
    backColor: [0.02, 0.027, 0.04, 1], crosshairColor: [0.24, 0.78, 0.47, 0.8], crosshairWidth: 0.4,
    crosshairWidthUnit: "percent", isCornerOrientationText: true,
    fontColor: [0.91, 0.69, 0.29, 1], multiplanarShowRender: 0, isColorbar: false, show3Dcrosshair: false, sliceType: 3,
    multiplanarPadPixels: 6, fontMinPx: 17,
  });
  await viewer.attachToCanvas(host.querySelector("canvas"));
  var number = {}, shown = null, share = 0.7;
  for (var layer of layers) {
    var image = await niivue.NVImage.loadFromBase64({
      base64: layer.data, name: layer.name + ".nii.gz", cal_min: layer.low, cal_max: layer.high,
      colormap: layer.kind === "grey" ? "gray" : G3R.colormap(layer.kind === "map" ? "map" : layer.name, viewer),
      opacity: layer.name === "volume" ? 1 : 0, colorbarVisible: false,
    });
    number[layer.name] = viewer.volumes.length;
    viewer.addVolume(image);
  }
  viewer.onLocationChange = function (location) {
    var found = layers.filter(function (one) { return one.kind !== "mark"; });
    told(location.mm, found.map(function (one) { return [one.title, location.values[number[one.name]].value]; }));
  };
  function redraw() {
    layers.forEach(function (one) {
      if (one.kind !== "mark" && one.name !== "volume") {
        var opaque = one.kind === "grey" ? 1 : share;
        viewer.volumes[number[one.name]].opacity = shown && shown.name === one.name ? opaque : 0;
      }
    });
    viewer.updateGLVolume();
  }
  viewer.setSliceType(viewer.sliceTypeMultiplanar);
  redraw();
  viewer.createOnLocationChange();
  return {
    show: function (layer) { shown = layer; redraw(); },
    mark: function (name, on) { viewer.volumes[number[name]].opacity = on ? G3R.MARK_COLORS[name][3] / 255 : 0; redraw(); },
    window: function (low, high) { viewer.volumes[0].cal_min = low; viewer.volumes[0].cal_max = high; redraw(); },
    opacity: function (value) { share = value; redraw(); },
  };
};
