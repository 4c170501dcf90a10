// Compiles the shader of docs/cpp.md as C++: the tests write it into shader.glsl, in a folder given by -I.
// check_shader apart|joint WORDS < six 32-bit floats an event > cos_theta ... column, density, d_out, offset as floats
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <vector>

namespace glsl {

using uint = std::uint32_t;

std::vector<uint> tsdf;

float uintBitsToFloat(uint bits) {
    float value;
    std::memcpy(&value, &bits, sizeof value);
    return value;
}
template <class T>
T min(T a, T b) { return b < a ? b : a; }
template <class T>
T max(T a, T b) { return a < b ? b : a; }
float sqrt(float x) { return std::sqrt(x); }
float cos(float x) { return std::cos(x); }
float sin(float x) { return std::sin(x); }

struct vec3 {
    float x, y, z;
};
vec3 operator*(float s, vec3 v) { return {s * v.x, s * v.y, s * v.z}; }
vec3 operator+(vec3 a, vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }

#include "shader.glsl"

}  // namespace glsl

int main(int argc, char** argv) {
    if (argc != 3) return 2;
    const bool joint = std::strcmp(argv[1], "joint") == 0;
    std::FILE* file = std::fopen(argv[2], "rb");
    if (file == nullptr) return 1;
    for (glsl::uint word; std::fread(&word, sizeof word, 1, file) == 1;) glsl::tsdf.push_back(word);
    std::fclose(file);
    const glsl::vec3 a{1, 0, 0}, b{0, 1, 0}, d{0, 0, 1};  // the frame that tsdf::frame gives to d
    for (float u[6]; std::fread(u, sizeof(float), 6, stdin) == 6;) {
        const glsl::TsdfEvent e = joint ? glsl::tsdf_sample_joint(u[0], u[1], u[2])
                                        : glsl::tsdf_sample(u[0], u[1], u[2], u[3], u[4], u[5]);
        const glsl::vec3 out = glsl::tsdf_direction(d, a, b, e), x = glsl::tsdf_offset(d, a, b, e);
        const float row[] = {e.cos_theta, e.phi_d, e.r, e.z, e.phi_delta, e.path_length, float(e.column),
                             glsl::tsdf_pdf(e.cos_theta), out.x, out.y, out.z, x.x, x.y, x.z};
        std::fwrite(row, sizeof row, 1, stdout);
    }
    return 0;
}
