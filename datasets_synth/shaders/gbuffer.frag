#version 450
// Surfaces under lamps, sun and sky, in one pass: no environment map (whose preparation takes SAPIEN 5.7 s of CPU in
// every process) and no shadows.
//
// outColor: BGR light in 0..255, gamma coded and NOT clipped, so that exposure can be applied afterwards. Its alpha must
// be one, because it is blended. outSegmentation: entity, and the bits of z depth in m; integers are never blended.

layout(constant_id = 0) const int NUM_DIRECTIONAL_LIGHTS = 0;
layout(constant_id = 1) const int NUM_POINT_LIGHTS = 0;

layout(set = 2, binding = 0) uniform MaterialBuffer {
  vec4 emission;
  vec4 baseColor;
  float fresnel;
  float roughness;
  float metallic;
  float transmission;
  float ior;
  float transmissionRoughness;
  int textureMask;
  int padding1;
  vec4 textureTransforms[6];
} material;

layout(set = 2, binding = 1) uniform sampler2D colorTexture;
layout(set = 2, binding = 5) uniform sampler2D emissionTexture;

struct PointLight {
  vec4 position;
  vec4 emission;
};

struct DirectionalLight {
  vec4 direction;
  vec4 emission;
};

struct SpotLight {
  vec4 position;
  vec4 direction;
  vec4 emission;
};

layout(set = 3, binding = 0) uniform SceneBuffer {
  vec4 ambientLight;
  DirectionalLight directionalLights[3];
  SpotLight spotLights[10];
  PointLight pointLights[10];
  SpotLight texturedLights[1];
} scene;

layout(location = 0) in vec4 place;
layout(location = 1) in vec3 upright;
layout(location = 2) in vec3 towardsEye;
layout(location = 3) in vec2 texel;
layout(location = 4) flat in uint entity;

layout(location = 0) out vec4 outColor;
layout(location = 1) out uvec4 outSegmentation;

const int HAS_COLOUR = 1, HAS_EMISSION = 16;
const float PI = 3.14159265358979;
const float FULL_SPECULAR = 0.08;  // reflectance along the normal where a material's specular is one

// Returns the share of light from direction l that a rough surface mirrors towards e, times the cosine of incidence:
// the microfacets of B. Karis, "Real shading in Unreal Engine 4", SIGGRAPH 2013.
float mirrored(vec3 n, vec3 l, vec3 e) {
  vec3 h = normalize(l + e);
  float nl = max(dot(n, l), 0), ne = max(dot(n, e), 1e-4), nh = max(dot(n, h), 0), eh = max(dot(e, h), 0);
  float squared = pow(material.roughness, 4), k = (material.roughness + 1) * (material.roughness + 1) / 8;
  float spread = nh * nh * (squared - 1) + 1;
  float along = FULL_SPECULAR * material.fresnel;
  float reflectance = along + (1 - along) * pow(max(1 - eh, 0), 5);
  float distribution = squared / (PI * spread * spread);
  return reflectance * distribution * nl / (4 * (nl * (1 - k) + k) * (ne * (1 - k) + k));
}

vec3 matte(vec3 n) {
  vec3 light = vec3(0);
  for (int i = 0; i < NUM_POINT_LIGHTS; ++i) {
    vec3 l = scene.pointLights[i].position.xyz - place.xyz;
    float inverse = inversesqrt(max(dot(l, l), 1e-8));
    light += scene.pointLights[i].emission.rgb * (max(dot(n, l), 0) * inverse * inverse * inverse);
  }
  for (int i = 0; i < NUM_DIRECTIONAL_LIGHTS; ++i)
    light += scene.directionalLights[i].emission.rgb * max(-dot(n, scene.directionalLights[i].direction.xyz), 0);
  return light / PI;
}

vec3 shine(vec3 n) {
  vec3 light = vec3(0), e = normalize(towardsEye);
  for (int i = 0; i < NUM_POINT_LIGHTS; ++i) {
    vec3 l = scene.pointLights[i].position.xyz - place.xyz;
    float inverse = inversesqrt(max(dot(l, l), 1e-8));
    light += scene.pointLights[i].emission.rgb * (inverse * inverse * mirrored(n, l * inverse, e));
  }
  for (int i = 0; i < NUM_DIRECTIONAL_LIGHTS; ++i)
    light += scene.directionalLights[i].emission.rgb * mirrored(n, -scene.directionalLights[i].direction.xyz, e);
  return light;
}

void main() {
  vec3 n = normalize(upright);
  vec3 surface = material.baseColor.rgb, seen = material.emission.rgb;
  if ((material.textureMask & HAS_COLOUR) != 0) surface = texture(colorTexture, texel).rgb;
  if ((material.textureMask & HAS_EMISSION) != 0) seen *= texture(emissionTexture, texel).rgb;
  seen += surface * (scene.ambientLight.rgb + matte(n));
  if (material.fresnel > 0) seen += shine(n);
  outColor = vec4(255 * pow(seen.bgr, vec3(1 / 2.2)), 1);
  outSegmentation = uvec4(entity, floatBitsToUint(place.w), 0, 0);
}
