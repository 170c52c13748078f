// What the picture is of: colours, depths, or which instance is where.

const LOOKS = ["colour", "depth", "instances"]; // as the shaders number them

const DEPTH_RANGE = [1, 100]; // metres: the ends of the colours, on a logarithmic scale
// From near to far at equal steps: viridis, as in the pictures of LiDAR scans.
const DEPTH_COLORS = [
  "#fde725", "#aadc32", "#5cc863", "#27ad81", "#21908d", "#2c718e", "#3b518b", "#472c7a", "#440154",
];
const STATIC = [-1, -1, -1]; // the label of what does not move: its own brightness, as a dark grey

const rgbOf = (hex) => [1, 3, 5].map((i) => Number.parseInt(hex.slice(i, i + 2), 16) / 255);

// The colour of an instance, three values in [0, 1]: the same for an id at any time and in any edit.
function labelOf({ id, samples }) {
  if (!samples) return STATIC;
  let hash = 2166136261; // FNV-1a
  for (const letter of id) hash = Math.imul(hash ^ letter.charCodeAt(0), 16777619) >>> 0;
  const [hue, light] = [(hash % 360) / 60, 0.55 + 0.2 * ((hash >>> 16) % 3)];
  return [5, 3, 1].map((offset) => {
    const turn = (offset + hue) % 6;
    return light * (1 - 0.75 * Math.max(0, Math.min(turn, 4 - turn, 1)));
  });
}

const SCREEN_VERTEX = `#version 300 es
layout(location = 0) in vec2 corner;

void main() {
  gl_Position = vec4(corner, 0.0, 1.0);
}`;

const DEPTH_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D sums; // of a pixel: the depths of its Gaussians times their shares, and in alpha the shares
uniform vec3 colors[${DEPTH_COLORS.length}];
uniform vec2 range;
out vec4 color;

void main() {
  vec4 sum = texelFetch(sums, ivec2(gl_FragCoord.xy), 0);
  float share = log(sum.r / max(sum.a, 1e-4) / range.x) / log(range.y / range.x);
  float x = clamp(share, 0.0, 1.0) * float(${DEPTH_COLORS.length - 1});
  int i = min(int(x), ${DEPTH_COLORS.length - 2});
  color = vec4(mix(colors[i], colors[i + 1], x - float(i)) * min(sum.a, 1.0), 1.0);
}`;

// Where depths are summed before they are coloured. begin(size) directs the drawing there, finish() colours the picture
// by the mean depths. Null where the browser cannot sum in half floats.
function depthTarget(gl, unit) {
  if (!gl.getExtension("EXT_color_buffer_float") && !gl.getExtension("EXT_color_buffer_half_float")) return null;
  const { made, uniforms } = program(gl, SCREEN_VERTEX, DEPTH_FRAGMENT);
  const [texture, buffer] = [gl.createTexture(), gl.createFramebuffer()];
  gl.useProgram(made);
  gl.uniform1i(uniforms.sums, unit);
  gl.uniform2fv(uniforms.range, DEPTH_RANGE);
  gl.uniform3fv(uniforms["colors[0]"], DEPTH_COLORS.flatMap(rgbOf));
  let known = [0, 0];
  const begin = (size) => {
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    if (size.some((pixels, i) => pixels !== known[i])) {
      known = size;
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, ...size, 0, gl.RGBA, gl.HALF_FLOAT, null);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    }
    gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
  };
  const finish = () => {
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.BLEND);
    gl.useProgram(made);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  };
  return { begin, finish };
}
