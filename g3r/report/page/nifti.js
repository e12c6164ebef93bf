"use strict";
// The images of the page: what this project wrote (one byte or two a voxel, gzip, axes right-anterior-superior).
var G3R = { data: JSON.parse(document.getElementById("report-data").textContent) };

G3R.bytes = function (base64) {
  var text = atob(base64), found = new Uint8Array(text.length);
  for (var n = 0; n < text.length; n++) found[n] = text.charCodeAt(n);
  return found;
};

// {shape, spacing, values, slope, zero, origin}; a voxel's value is slope * stored + zero
G3R.readImage = async function (base64) {
  var packed = new Blob([G3R.bytes(base64)]).stream().pipeThrough(new DecompressionStream("gzip"));
  var buffer = await new Response(packed).arrayBuffer(), header = new DataView(buffer);
  var at = header.getFloat32(108, true), twoBytes = header.getInt16(70, true) === 4;
  var three = function (place, read) { return [0, 1, 2].map(function (n) { return read(place, n); }); };
  return {
    shape: three(42, function (place, n) { return header.getInt16(place + 2 * n, true); }),
    spacing: three(80, function (place, n) { return header.getFloat32(place + 4 * n, true); }),
    origin: three(280, function (place, n) { return header.getFloat32(place + 16 * n + 12, true); }),
    slope: header.getFloat32(112, true), zero: header.getFloat32(116, true),
    values: twoBytes ? new Int16Array(buffer.slice(at)) : new Uint8Array(buffer, at),
  };
};

G3R.MARK_COLORS = { unseen: [53, 196, 232, 110], mask: [240, 200, 80, 200] };
