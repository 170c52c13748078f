// The splat and its sky on the graphics card: textures from the page's arrays, and the drawing of one view.

const TEXTURE_WIDTH = 4096;

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) {
    throw new Error(`the shaders do not link (${gl.getProgramInfoLog(made)})`);
  }
  const uniforms = {};
  for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = gl.getActiveUniform(made, i);
    uniforms[name] = gl.getUniformLocation(made, name);
  }
  return { made, uniforms };
}

// Rows of `channels` values as texels, TEXTURE_WIDTH to a line.
function valueTexture(gl, unit, values, channels, [internal, format, type]) {
  const texels = values.length / channels;
  const width = Math.max(1, Math.min(TEXTURE_WIDTH, texels));
  const height = Math.max(1, Math.ceil(texels / width));
  if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
    throw new Error("this graphics card cannot hold so many Gaussians; set export.viewer_gaussians lower");
  }
  const padded = new values.constructor(width * height * channels);
  padded.set(values);
  const texture = gl.createTexture();
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, padded);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  return texture;
}

function skyTexture(gl, unit, texels, size) {
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_CUBE_MAP, gl.createTexture());
  for (let face = 0; face < 6; face++) {
    const pixels = texels.subarray(face * size * size * 3, (face + 1) * size * size * 3);
    const target = gl.TEXTURE_CUBE_MAP_POSITIVE_X + face;
    gl.texImage2D(target, 0, gl.RGB8, size, size, 0, gl.RGB, gl.UNSIGNED_BYTE, pixels);
  }
  gl.texParameteri(gl.TEXTURE_CUBE_MAP, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
}

// Which instance each row belongs to; set anew for another drive.
function instanceTexture(gl, unit) {
  let texture = null;
  return (ranges) => {
    const numbers = new Uint16Array(ranges.reduce((sum, { begin, end }) => sum + end - begin, 0));
    ranges.forEach(({ begin, end, row }, number) => numbers.fill(number, row, row + end - begin));
    gl.deleteTexture(texture);
    texture = valueTexture(gl, unit, numbers, 1, [gl.R16UI, gl.RED_INTEGER, gl.UNSIGNED_SHORT]);
  };
}

const SAME_COLORS = [1, 0, 0, 0, 1, 0, 0, 0, 1];

// The poses, colour matrices, labels and weights of up to `modes` modes of the instances, a line for each: filled anew
// for every picture.
function poseTexture(gl, unit, modes) {
  const texture = gl.createTexture();
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  return (ranges) => {
    const texels = 7 + Math.ceil(modes / 4);
    const values = new Float32Array(4 * texels * ranges.length);
    ranges.forEach(({ begin, row, pose, colors, label, modes: first, weights }, line) => {
      if (!pose) return;
      const matrix = [0, 1, 2].flatMap((i) => [...(colors || SAME_COLORS).slice(3 * i, 3 * i + 3), label[i]]);
      const state = [begin - row, 1, row, weights ? first : -1];
      values.set([...pose, ...state, ...matrix, ...(weights || [])], 4 * texels * line);
    });
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, texels, ranges.length, 0, gl.RGBA, gl.FLOAT, values);
  };
}

// The arrays of the page as textures, each on the unit at which the shaders look for it. Returns the next free unit.
function uploadTextures(gl, arrays, uniforms) {
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  const formats = {
    means: [3, [gl.RGB32F, gl.RGB, gl.FLOAT]],
    scales: [3, [gl.RGB16F, gl.RGB, gl.HALF_FLOAT]],
    quats: [4, [gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT]],
    opacities: [1, [gl.R8, gl.RED, gl.UNSIGNED_BYTE]],
    sh0: [3, [gl.RGB16F, gl.RGB, gl.HALF_FLOAT]],
    shN: [3, [gl.RGB8_SNORM, gl.RGB, gl.BYTE]],
    modes: [3, [gl.RGB8_SNORM, gl.RGB, gl.BYTE]],
  };
  Object.entries(formats).forEach(([name, [channels, format]], unit) => {
    valueTexture(gl, unit, arrays[name], channels, format);
    gl.uniform1i(uniforms[name], unit);
  });
  return Object.keys(formats).length;
}

// Two triangles over [-1, 1]², and for each drawing of them its row.
function geometry(gl) {
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
  const indices = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, indices);
  gl.enableVertexAttribArray(1);
  gl.vertexAttribIPointer(1, 1, gl.UNSIGNED_INT, 0, 0);
  gl.vertexAttribDivisor(1, 1);
}

function setCamera(gl, { made, uniforms }, rotation, position, { focal, center }, size) {
  gl.useProgram(made);
  gl.uniformMatrix3fv(uniforms.cameraToWorld, true, rotation.flat());
  if (uniforms.position) gl.uniform3fv(uniforms.position, position);
  gl.uniform2fv(uniforms.focal, focal);
  gl.uniform2fv(uniforms.center, center);
  gl.uniform2fv(uniforms.size, size);
}

// Returns { setDrive, setOrder, draw, looks }. setDrive(ranges) tells which rows there are, setOrder(rows) which are
// drawn, far to near; draw(view, ranges, { look, sky }) draws the sky, then them over it, and returns their number.
// `looks` are those of LOOKS that this browser can draw. A range has with `pose` the pose of its instance, null if it
// is not shown, and with `label` the colour of it. Throws where the browser has no WebGL 2.
function painter(canvas, scene, arrays) {
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false });
  if (!gl) throw new Error("this browser has no WebGL 2; update it, or allow it to use the graphics card");
  const [sky, splat] = [program(gl, SKY_VERTEX, SKY_FRAGMENT), program(gl, SPLAT_VERTEX, SPLAT_FRAGMENT)];
  gl.useProgram(splat.made);
  const unit = uploadTextures(gl, arrays, splat.uniforms);
  const [setDrive, setPoses] = [instanceTexture(gl, unit), poseTexture(gl, unit + 1, scene.modes)];
  gl.uniform1i(splat.uniforms.instance, unit);
  gl.uniform1i(splat.uniforms.poses, unit + 1);
  gl.uniform1f(splat.uniforms.shRange, scene.sh_range);
  gl.uniform1i(splat.uniforms.coefficients, scene.coefficients);
  gl.uniform1f(splat.uniforms.modesRange, scene.modes_range);
  gl.uniform1i(splat.uniforms.modeCount, scene.modes);
  gl.uniform1i(splat.uniforms.antialiased, scene.antialiased);
  gl.useProgram(sky.made);
  skyTexture(gl, unit + 2, arrays.sky, scene.sky_size);
  gl.uniform1i(sky.uniforms.sky, unit + 2);
  const depth = depthTarget(gl, unit + 3);
  geometry(gl);
  gl.clearColor(0, 0, 0, 1);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  let count = 0;
  const setOrder = (rows) => {
    count = rows.length;
    gl.bufferData(gl.ARRAY_BUFFER, rows, gl.DYNAMIC_DRAW);
  };
  const looks = LOOKS.filter((look) => look !== "depth" || depth);
  const draw = (view, ranges, { look, sky: skyShown }) => {
    const size = [canvas.width, canvas.height];
    const [rotation, lens] = [rotationOf(view), pinhole(scene.frame, ...size)];
    setPoses(ranges);
    gl.viewport(0, 0, ...size);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.disable(gl.BLEND);
    if (look === "depth") depth.begin(size);
    if (look === "colour" && skyShown) {
      setCamera(gl, sky, rotation, view.position, lens, size);
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    }
    gl.enable(gl.BLEND);
    setCamera(gl, splat, rotation, view.position, lens, size);
    gl.uniform1i(splat.uniforms.look, LOOKS.indexOf(look));
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
    if (look === "depth") depth.finish();
    return count;
  };
  return { setDrive, setOrder, draw, looks };
}
