// How a Gaussian and the sky are drawn, with gsplat's projection and cut-offs: the picture is the one that was trained.

const NEAR = 0.01; // metres: gsplat's near plane

const SPLAT_VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;

layout(location = 0) in vec2 corner;
layout(location = 1) in uint row;

uniform sampler2D means, scales, quats, opacities, sh0, shN, modes;
uniform usampler2D instance; // the number of each row's instance
// a line for each instance: three rows of [rotation | place], [from row to Gaussian, shown, first row, first row of its
// modes or -1], three rows of [colour matrix | label], the weights of its modes
uniform sampler2D poses;
uniform float shRange, modesRange;
uniform int coefficients, modeCount, look; // look: the number in LOOKS
uniform bool antialiased;
uniform mat3 cameraToWorld;
uniform vec3 position;
uniform vec2 focal, center, size;

out vec2 sigmas;
out vec4 color;

const float EPS2D = 0.3; // square pixels that gsplat's 2D filter adds
const float LEAST_ALPHA = 1.0 / 255.0;
const float DEPTH_LIMIT = 1000.0; // metres: half floats sum depths up to it

vec4 texel(sampler2D values, uint i) {
  uint width = uint(textureSize(values, 0).x);
  return texelFetch(values, ivec2(int(i % width), int(i / width)), 0);
}

mat3 rotation(vec4 q) {
  q = normalize(q);
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

// The 2D covariance in square pixels as xx, xy, yy: EWA, its linearisation held inside the picture as gsplat holds it.
vec3 projected(mat3 axes, vec3 p) {
  vec2 margin = 0.15 * size / focal;
  vec2 t = clamp(p.xy / p.z, -center / focal - margin, (size - center) / focal + margin);
  mat3 m = transpose(cameraToWorld) * axes;
  vec2 f = focal / p.z;
  vec3 jx = f.x * (vec3(m[0].x, m[1].x, m[2].x) - t.x * vec3(m[0].z, m[1].z, m[2].z));
  vec3 jy = f.y * (vec3(m[0].y, m[1].y, m[2].y) - t.y * vec3(m[0].z, m[1].z, m[2].z));
  return vec3(dot(jx, jx), dot(jx, jy), dot(jy, jy));
}

vec3 coefficient(uint i, int k) {
  vec3 root = texel(shN, i * uint(coefficients - 1) + uint(k - 1)).rgb;
  return shRange * root * abs(root);
}

vec3 mode(uint i) {
  vec3 root = texel(modes, i).rgb;
  return modesRange * root * abs(root);
}

// Real spherical harmonics as 3D Gaussian Splatting orders and signs them, up to degree 3.
vec3 radiance(uint i, vec3 d) {
  vec3 sum = 0.5 + 0.28209479177387814 * texel(sh0, i).rgb;
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  if (coefficients > 1) sum += 0.4886025119029199 *
    (-y * coefficient(i, 1) + z * coefficient(i, 2) - x * coefficient(i, 3));
  if (coefficients > 4) sum +=
    1.0925484305920792 * (x * y * coefficient(i, 4) - y * z * coefficient(i, 5) - x * z * coefficient(i, 7)) +
    0.31539156525252005 * (2.0 * zz - xx - yy) * coefficient(i, 6) +
    0.5462742152960396 * (xx - yy) * coefficient(i, 8);
  if (coefficients > 9) sum +=
    -0.5900435899266435 * (y * (3.0 * xx - yy) * coefficient(i, 9) + x * (xx - 3.0 * yy) * coefficient(i, 15)) +
    2.890611442640554 * x * y * z * coefficient(i, 10) -
    0.4570457994644658 * (4.0 * zz - xx - yy) * (y * coefficient(i, 11) + x * coefficient(i, 13)) +
    0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * coefficient(i, 12) +
    1.445305721320277 * z * (xx - yy) * coefficient(i, 14);
  return sum;
}

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // outside: nothing is drawn
  uint width = uint(textureSize(instance, 0).x);
  int line = int(texelFetch(instance, ivec2(int(row % width), int(row / width)), 0).r);
  vec4 state = texelFetch(poses, ivec2(3, line), 0);
  if (state.y == 0.0) return; // not shown any more: the order is of a moment ago
  uint index = uint(int(row) + int(state.x)); // of the Gaussian
  vec4 rows[3] = vec4[3](
    texelFetch(poses, ivec2(0, line), 0), texelFetch(poses, ivec2(1, line), 0), texelFetch(poses, ivec2(2, line), 0));
  mat3 toWorld = transpose(mat3(rows[0].xyz, rows[1].xyz, rows[2].xyz));
  vec3 shift = vec3(0.0), turn = vec3(0.0); // in the frame of the group
  if (state.w >= 0.0) {
    uint first = (uint(state.w) + row - uint(state.z)) * uint(2 * modeCount);
    for (int k = 0; k < modeCount; k++) {
      float weight = texelFetch(poses, ivec2(7 + k / 4, line), 0)[k % 4];
      shift += weight * mode(first + uint(2 * k));
      turn += weight * mode(first + uint(2 * k + 1));
    }
  }
  vec3 mean = toWorld * (texel(means, index).xyz + shift) + vec3(rows[0].w, rows[1].w, rows[2].w);
  vec3 p = (mean - position) * cameraToWorld;
  if (p.z <= ${NEAR}) return; // behind the camera by now: the order is of a moment ago
  vec3 scale = texel(scales, index).xyz;
  mat3 axes = toWorld * rotation(vec4(1.0, turn)) * rotation(texel(quats, index));
  vec3 cov = projected(mat3(axes[0] * scale.x, axes[1] * scale.y, axes[2] * scale.z), p);
  float sharp = max(cov.x * cov.z - cov.y * cov.y, 0.0);
  cov.xz += EPS2D;
  float alpha = texel(opacities, index).r;
  if (antialiased) alpha *= sqrt(sharp / (cov.x * cov.z - cov.y * cov.y));
  if (alpha < LEAST_ALPHA) return;

  float mid = 0.5 * (cov.x + cov.z), spread = length(vec2(0.5 * (cov.x - cov.z), cov.y));
  vec2 major = spread < 1e-6 * mid ? vec2(1.0, 0.0) : vec2(0.5 * (cov.x - cov.z) + spread, cov.y);
  if (dot(major, major) < 1e-12 * mid * mid) major = vec2(0.0, 1.0);
  major = normalize(major);
  float reach = sqrt(2.0 * log(alpha / LEAST_ALPHA));
  sigmas = reach * corner;
  vec2 offset = sigmas.x * sqrt(mid + spread) * major +
    sigmas.y * sqrt(max(mid - spread, 0.0)) * vec2(-major.y, major.x);
  vec2 pixel = focal * p.xy / p.z + center + offset;
  gl_Position = vec4((2.0 * pixel / size - 1.0) * vec2(1.0, -1.0), 0.0, 1.0);
  vec4 red = texelFetch(poses, ivec2(4, line), 0), green = texelFetch(poses, ivec2(5, line), 0),
    blue = texelFetch(poses, ivec2(6, line), 0);
  vec3 radiant = radiance(index, normalize((mean - position) * toWorld)) * mat3(red.xyz, green.xyz, blue.xyz);
  color = vec4(max(radiant, 0.0), alpha);
  vec3 label = vec3(red.w, green.w, blue.w);
  if (look == 1) color.rgb = vec3(min(p.z, DEPTH_LIMIT), 0.0, 0.0);
  if (look == 2) color.rgb = label.r < 0.0 ? vec3(0.45 * dot(color.rgb, vec3(0.3, 0.6, 0.1))) : label;
}`;

const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
in vec2 sigmas;
in vec4 color;
out vec4 premultiplied;

void main() {
  float alpha = min(0.999, color.a * exp(-0.5 * dot(sigmas, sigmas)));
  if (alpha < 1.0 / 255.0) discard;
  premultiplied = vec4(color.rgb * alpha, alpha);
}`;

const SKY_VERTEX = `#version 300 es
precision highp float;
layout(location = 0) in vec2 corner;
uniform mat3 cameraToWorld;
uniform vec2 focal, center, size;
out vec3 ray;

void main() {
  vec2 pixel = (corner * vec2(0.5, -0.5) + 0.5) * size;
  ray = cameraToWorld * vec3((pixel - center) / focal, 1.0);
  gl_Position = vec4(corner, 0.0, 1.0);
}`;

const SKY_FRAGMENT = `#version 300 es
precision highp float;
uniform samplerCube sky;
in vec3 ray;
out vec4 color;

void main() {
  color = vec4(texture(sky, ray).rgb, 1.0);
}`;
