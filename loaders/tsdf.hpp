// TSDF tables for C++17: load a .tsdf.exr file, check it, draw from it. One header, nothing but the standard library.
//
// The reader follows schema/SPEC.md and checks every rule of it; the inflate, SHA-256 and JSON it needs are in here.
// Sampling is Algorithm 1 of Meng et al. 2015 (doi 10.1145/2766949) by exact inversion of cumulative masses with guide
// tables (Chen & Asau 1974): the same random numbers give the same events as tsdf.data.sampler in Python. Nothing here
// throws of itself, nothing allocates once `Sampler::prepare` is done, and a const Sampler serves any number of threads.
// Lengths are in units of R, the radius of the bounding sphere, angles in radians. Buffers and a shader: docs/cpp.md.
// Licence: MIT.
#ifndef TSDF_HPP
#define TSDF_HPP

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <initializer_list>
#include <limits>
#include <string>
#include <system_error>
#include <utility>
#include <vector>

namespace tsdf {

constexpr int format_major = 1, format_minor = 1;  // of the specification that this reads
constexpr double pi = 3.14159265358979323846;

// A broken rule: its code in section 9 of SPEC.md, where, and one line of text.
struct Finding {
    std::string code, place, message;
};

// What became of a call: no error if `code` is empty. Text from a file stands in it only as printable ASCII.
struct Result {
    std::string code, place, message;
    std::vector<Finding> warnings;
    explicit operator bool() const noexcept { return code.empty(); }
};

// A value of the JSON header. Text is UTF-8.
struct Value {
    enum class Type : std::uint8_t { null, boolean, number, text, array, object };
    Type type = Type::null;
    bool truth = false;
    bool whole = false;        // a number written as an integer: `integer` holds it exactly
    std::int64_t integer = 0;  // 0 if not `whole`
    double number = 0.0;
    std::string text;
    std::vector<std::string> keys;  // of an object, in the order of the file
    std::vector<Value> items;       // of an array, or of an object beside `keys`

    // Member of an object, nullptr if there is none.
    const Value* find(const char* key) const noexcept {
        for (std::size_t i = 0; i < keys.size(); ++i)
            if (keys[i] == key) return &items[i];
        return nullptr;
    }
};

// Means over the scattered light of the lossless grain, or their standard errors; SPEC.md, section 3.
struct Statistics {
    double hit_probability = 0, albedo = 0, mean_cosine = 0, mean_z = 0, mean_r = 0, mean_miss_chord = 0;
    double mean_path_length = 0, atom_forward = 0, atom_backward = 0;
    std::array<double, 17> legendre_moments{};
};

// Rows of the image: `rows` of them from `first_row`; `edges`, rows + 1 of them, only where they are cells of an axis.
struct Block {
    std::size_t first_row = 0, rows = 0;
    std::vector<double> edges;
};

// Mean lengths of the way of light through grains, in the unit of the radius given [1].
struct FreePath {
    double lambda_b = 0;      // mean gap between bounding spheres
    double lambda_delta = 0;  // mean chord through bounding spheres whose grain is missed
    double lambda_beta = 0;   // mean free path from leaving one grain to meeting the next
    double lambda_s = 0;      // mean advance z in a grain
};

// The homogeneous medium of point scatterers that stands for the grains.
struct VolumeParameters {
    double sigma_t = 0;  // extinction [1/unit]
    double albedo = 0;   // single-scattering albedo
    double g = 0;        // mean cosine; not a number where nothing is let out
};

// The scattering of one grain, as `load` leaves it.
struct Table {
    std::size_t columns = 0, rows = 0;
    std::vector<float> pixels;            // rows x columns, row by row
    std::vector<double> cos_theta_edges;  // columns + 1, from -1 to 1; the first and last cell are atoms of no width
    Block p_theta, p_phi, p_r, p_z, p_l, mean_l;
    std::size_t records = 0;                                                              // joint records per column
    Block joint_r, joint_z, joint_phi_delta, joint_l, joint_entry_b2, joint_entry_azimuth;  // empty if there are none
    // Records by entry, of which column c is the cell c / columns .. (c + 1) / columns of entry_b2; empty if there are
    // none. memory_hit is the share of the rays of the cell that meet the grain.
    std::size_t memory_records = 0;
    Block memory_hit, memory_cos_theta, memory_entry_azimuth, memory_r, memory_z, memory_phi_delta, memory_l;
    Block memory_entry_b2;
    Statistics statistics, standard_errors;
    double bounding_radius = 0;  // R, in the unit of the grain's source
    double eta = 0;              // refractive index inside over outside
    Value header;                // all of it

    const float* row(std::size_t y) const noexcept { return pixels.data() + y * columns; }

    // Share of the light of column c that a grain lets out; absorption = sigma_a R >= 0.
    double survival(std::size_t c, double absorption) const noexcept {
        if (absorption == 0.0) return 1.0;
        double sum = 0.0;
        for (std::size_t k = 0; k < p_l.rows; ++k)
            sum += double(row(p_l.first_row + k)[c]) *
                   std::exp(-(std::min)(absorption, 1e30) * double(row(mean_l.first_row + k)[c]));
        return sum;
    }

    // Energy that leaves over energy that met the grain, for absorption = sigma_a R; NaN if it is negative.
    double albedo(double absorption = 0.0) const noexcept {
        if (!(absorption >= 0.0)) return std::numeric_limits<double>::quiet_NaN();
        double all = 0.0, out = 0.0;
        for (std::size_t c = 0; c < columns; ++c) {
            const double p = double(row(p_theta.first_row)[c]);
            all += p;
            out += p * survival(c, absorption);
        }
        return statistics.albedo * out / all;
    }

    // Mean cosine in [-1, 1] of what is let out, for absorption = sigma_a R; NaN if that is negative or nothing is.
    double mean_cosine(double absorption = 0.0) const noexcept {
        if (!(absorption >= 0.0)) return std::numeric_limits<double>::quiet_NaN();
        const auto inside = [](double g) { return (std::min)((std::max)(g, -1.0), 1.0); };
        const double given = inside(statistics.mean_cosine);
        if (absorption == 0.0) return given;
        double all = 0.0, lossless = 0.0, out = 0.0, absorbing = 0.0;
        for (std::size_t c = 0; c < columns; ++c) {
            const double p = double(row(p_theta.first_row)[c]), q = p * survival(c, absorption);
            const double middle = 0.5 * (cos_theta_edges[c] + cos_theta_edges[c + 1]);
            all += p;
            lossless += p * middle;
            out += q;
            absorbing += q * middle;
        }
        if (!(out > 0.0)) return std::numeric_limits<double>::quiet_NaN();
        return inside(given + absorbing / out - lossless / all);
    }

    // Free path among grains of bounding radius R > 0 whose bounding spheres fill a share f in (0, 0.74] of space;
    // every length is NaN outside that domain, or if no ray ever meets the grain.
    FreePath free_path(double f, double radius) const noexcept {
        const double beta = statistics.hit_probability;
        if (!(f > 0.0 && f <= 0.74 && radius > 0.0 && beta > 0.0)) {
            const double nan = std::numeric_limits<double>::quiet_NaN();
            return {nan, nan, nan, nan};
        }
        FreePath path;
        path.lambda_b = 4.0 * (1.0 - f) / (3.0 * f) * radius;
        path.lambda_delta = beta < 1.0 ? statistics.mean_miss_chord * radius : 0.0;
        path.lambda_beta = path.lambda_b + (path.lambda_b + path.lambda_delta) * (1.0 - beta) / beta;
        path.lambda_s = statistics.mean_z * radius;
        return path;
    }

    // Extinction coefficient of point scatterers, 1 / (lambda_beta + albedo lambda_s) [1/unit of the radius]; NaN where
    // that is not positive, which a negative mean_z in a dense packing can do.
    double sigma_t(double f, double radius, double single_scattering_albedo) const noexcept {
        const FreePath path = free_path(f, radius);
        const double way = path.lambda_beta + single_scattering_albedo * path.lambda_s;
        return way > 0.0 ? 1.0 / way : std::numeric_limits<double>::quiet_NaN();
    }

    // The medium of point scatterers that stands for grains of absorption coefficient sigma_a [1/unit of the radius].
    VolumeParameters volume_parameters(double f, double radius, double sigma_a = 0.0) const noexcept {
        const double out = albedo(sigma_a * radius);
        return {sigma_t(f, radius, out), out, mean_cosine(sigma_a * radius)};
    }
};

// ------------------------------------------------------------------------------------------------------- bytes

namespace detail {

using Bytes = std::vector<std::uint8_t>;

// Not std::isfinite, which compilers leave out where they are told that all mathematics is fast.
inline bool finite(double value) noexcept {
    constexpr std::uint64_t exponent = std::uint64_t(0x7ff) << 52;
    std::uint64_t bits;
    std::memcpy(&bits, &value, sizeof bits);
    return (bits & exponent) != exponent;
}

inline std::uint32_t word(const std::uint8_t* p) noexcept {
    return std::uint32_t(p[0]) | std::uint32_t(p[1]) << 8 | std::uint32_t(p[2]) << 16 | std::uint32_t(p[3]) << 24;
}

// SHA-256, FIPS 180-4.
class Sha256 {
  public:
    void add(const std::uint8_t* data, std::size_t size) noexcept {
        length += size;
        while (size > 0) {
            const std::size_t part = (std::min)(size, std::size_t(64) - filled);
            std::memcpy(block + filled, data, part);
            filled += part;
            data += part;
            size -= part;
            if (filled == 64) {
                mix();
                filled = 0;
            }
        }
    }

    std::string digits() noexcept {
        const std::uint64_t bits = length * 8;
        const std::uint8_t one = 0x80, zero = 0;
        add(&one, 1);
        while (filled != 56) add(&zero, 1);
        std::uint8_t end[8];
        for (unsigned i = 0; i < 8; ++i) end[i] = std::uint8_t(bits >> (56 - 8 * i));
        add(end, 8);
        std::string text;
        for (std::uint32_t h : state)
            for (unsigned i = 0; i < 8; ++i) text += "0123456789abcdef"[h >> (28 - 4 * i) & 15];
        return text;
    }

  private:
    static std::uint32_t turn(std::uint32_t x, unsigned n) noexcept { return x >> n | x << (32 - n); }

    void mix() noexcept {
        static constexpr std::uint32_t k[64] = {
            0x428a2f98, 0x71374491, 0xb5c0fbcf, 0xe9b5dba5, 0x3956c25b, 0x59f111f1, 0x923f82a4, 0xab1c5ed5,
            0xd807aa98, 0x12835b01, 0x243185be, 0x550c7dc3, 0x72be5d74, 0x80deb1fe, 0x9bdc06a7, 0xc19bf174,
            0xe49b69c1, 0xefbe4786, 0x0fc19dc6, 0x240ca1cc, 0x2de92c6f, 0x4a7484aa, 0x5cb0a9dc, 0x76f988da,
            0x983e5152, 0xa831c66d, 0xb00327c8, 0xbf597fc7, 0xc6e00bf3, 0xd5a79147, 0x06ca6351, 0x14292967,
            0x27b70a85, 0x2e1b2138, 0x4d2c6dfc, 0x53380d13, 0x650a7354, 0x766a0abb, 0x81c2c92e, 0x92722c85,
            0xa2bfe8a1, 0xa81a664b, 0xc24b8b70, 0xc76c51a3, 0xd192e819, 0xd6990624, 0xf40e3585, 0x106aa070,
            0x19a4c116, 0x1e376c08, 0x2748774c, 0x34b0bcb5, 0x391c0cb3, 0x4ed8aa4a, 0x5b9cca4f, 0x682e6ff3,
            0x748f82ee, 0x78a5636f, 0x84c87814, 0x8cc70208, 0x90befffa, 0xa4506ceb, 0xbef9a3f7, 0xc67178f2};
        std::uint32_t w[64];
        for (unsigned i = 0; i < 16; ++i)
            w[i] = std::uint32_t(block[4 * i]) << 24 | std::uint32_t(block[4 * i + 1]) << 16 |
                   std::uint32_t(block[4 * i + 2]) << 8 | std::uint32_t(block[4 * i + 3]);
        for (unsigned i = 16; i < 64; ++i)
            w[i] = w[i - 16] + (turn(w[i - 15], 7) ^ turn(w[i - 15], 18) ^ w[i - 15] >> 3) + w[i - 7] +
                   (turn(w[i - 2], 17) ^ turn(w[i - 2], 19) ^ w[i - 2] >> 10);
        std::uint32_t s[8];
        std::memcpy(s, state, sizeof s);
        for (unsigned i = 0; i < 64; ++i) {
            const std::uint32_t a = s[7] + (turn(s[4], 6) ^ turn(s[4], 11) ^ turn(s[4], 25)) +
                                    ((s[4] & s[5]) ^ (~s[4] & s[6])) + k[i] + w[i];
            const std::uint32_t b = (turn(s[0], 2) ^ turn(s[0], 13) ^ turn(s[0], 22)) +
                                    ((s[0] & s[1]) ^ (s[0] & s[2]) ^ (s[1] & s[2]));
            for (unsigned j = 7; j > 0; --j) s[j] = s[j - 1];
            s[4] += a;
            s[0] = a + b;
        }
        for (unsigned i = 0; i < 8; ++i) state[i] += s[i];
    }

    std::uint32_t state[8] = {0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a,
                              0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
    std::uint8_t block[64] = {};
    std::size_t filled = 0;
    std::uint64_t length = 0;
};

// Inflates one zlib stream (RFC 1950, 1951) to exactly as many bytes as are asked for.
class Inflate {
  public:
    Inflate(const std::uint8_t* data, std::size_t count) noexcept : in(data), size(count) {}

    // False unless the stream is sound, has nothing after it and fills `out` exactly.
    bool run(Bytes& out) {
        if (size < 6 || (in[0] & 15) != 8 || in[0] >> 4 > 7 || (in[0] * 256 + in[1]) % 31 != 0 || (in[1] & 32) != 0)
            return false;
        at = 2;
        std::size_t n = 0;
        for (bool last = false; !last;) {
            last = take(1) != 0;
            const unsigned kind = take(2);
            if (kind == 3 || bad) return false;
            if (kind == 0 ? !stored(out, n) : !coded(out, n, kind == 2)) return false;
        }
        if (!align() || n != out.size() || size - at != 4) return false;
        std::uint32_t a = 1, b = 0;
        for (std::uint8_t byte : out) {
            a += byte;
            a -= a >= 65521 ? 65521 : 0;
            b += a;
            b -= b >= 65521 ? 65521 : 0;
        }
        const std::uint8_t* end = in + at;
        return std::uint32_t((end[0] << 8 | end[1])) == b && std::uint32_t((end[2] << 8 | end[3])) == a;
    }

  private:
    // A prefix code: the next `bits` bits index `entry`, which is symbol << 4 | length, 0 where there is no symbol.
    struct Code {
        std::vector<std::uint16_t> entry;
        unsigned bits = 0;
    };

    static bool build(Code& code, const std::uint8_t* lengths, unsigned count, bool may_be_short) {
        unsigned of_length[16] = {}, next[16] = {};
        for (unsigned i = 0; i < count; ++i) ++of_length[lengths[i]];
        of_length[0] = 0;
        code.bits = 0;
        int left = 1;
        for (unsigned n = 1; n < 16; ++n) {
            left = 2 * left - int(of_length[n]);
            if (left < 0) return false;
            if (of_length[n] > 0) code.bits = n;
            next[n] = n > 1 ? (next[n - 1] + of_length[n - 1]) << 1 : 0;
        }
        // As zlib: a code that leaves words unused is sound only if it has one word of one bit, or none
        if (left > 0 && code.bits > 0 && !(may_be_short && code.bits == 1)) return false;
        code.entry.assign(std::size_t(1) << code.bits, 0);
        for (unsigned i = 0; i < count; ++i) {
            const unsigned n = lengths[i];
            if (n == 0) continue;
            unsigned reversed = 0;
            for (unsigned bit = 0, value = next[n]++; bit < n; ++bit, value >>= 1)
                reversed = reversed << 1 | (value & 1);
            for (std::size_t j = reversed; j < code.entry.size(); j += std::size_t(1) << n)
                code.entry[j] = std::uint16_t(i << 4 | n);
        }
        return true;
    }

    void fill() noexcept {
        while (held <= 48) {
            if (at < size)
                buffer |= std::uint64_t(in[at++]) << held;
            else
                ++invented;  // zeros, which nobody may use
            held += 8;
        }
    }

    void drop(unsigned n) noexcept {
        buffer >>= n;
        held -= n;
        bad = bad || held < 8 * invented;
    }

    unsigned take(unsigned n) noexcept {
        fill();
        const unsigned value = unsigned(buffer & ((std::uint64_t(1) << n) - 1));
        drop(n);
        return value;
    }

    // Next symbol, or 1000 where there is none.
    unsigned symbol(const Code& code) noexcept {
        fill();
        const unsigned entry = code.entry[std::size_t(buffer & ((std::uint64_t(1) << code.bits) - 1))];
        if ((entry & 15) == 0) bad = true;
        drop(entry & 15);
        return bad ? 1000 : entry >> 4;
    }

    // Give back the whole bytes that were read ahead.
    bool align() noexcept {
        drop(held % 8);
        if (bad) return false;
        at -= std::size_t(held / 8 - invented);
        buffer = 0;
        held = invented = 0;
        return true;
    }

    bool stored(Bytes& out, std::size_t& n) noexcept {
        if (!align() || size - at < 4) return false;
        const std::size_t length = std::size_t(in[at] | in[at + 1] << 8);
        if ((length ^ 0xffff) != std::size_t(in[at + 2] | in[at + 3] << 8)) return false;
        at += 4;
        if (size - at < length || out.size() - n < length) return false;
        if (length > 0) std::memcpy(out.data() + n, in + at, length);
        at += length;
        n += length;
        return true;
    }

    bool coded(Bytes& out, std::size_t& n, bool dynamic) {
        std::uint8_t lengths[320] = {};
        unsigned literals = 288, distances = 32;
        if (dynamic) {
            if (!code_lengths(lengths, literals, distances)) return false;
        } else {
            for (unsigned i = 0; i < 320; ++i)
                lengths[i] = i < 144 ? 8 : i < 256 ? 9 : i < 280 ? 7 : i < 288 ? 8 : 5;
        }
        if (!build(literal, lengths, literals, true) || !build(distance, lengths + literals, distances, true))
            return false;
        static constexpr std::uint16_t base[30] = {1,   2,   3,   4,   5,   7,    9,    13,   17,   25,
                                                   33,  49,  65,  97,  129, 193,  257,  385,  513,  769,
                                                   1025, 1537, 2049, 3073, 4097, 6145, 8193, 12289, 16385, 24577};
        static constexpr std::uint8_t run[29] = {0,  1,  2,  3,  4,  5,  6,  7,  8,  10,  12,  14,  16,  20, 24,
                                                 28, 32, 40, 48, 56, 64, 80, 96, 112, 128, 160, 192, 224, 255};
        for (;;) {
            const unsigned s = symbol(literal);
            if (s == 256) return true;
            if (s < 256) {
                if (n == out.size()) return false;
                out[n++] = std::uint8_t(s);
                continue;
            }
            if (s > 285) return false;
            const unsigned i = s - 257;
            const std::size_t length = 3 + run[i] + (i < 8 || i == 28 ? 0u : take((i - 4) / 4));
            const unsigned d = symbol(distance);
            if (d > 29) return false;
            const std::size_t back = base[d] + (d < 4 ? 0u : take((d - 2) / 2));
            if (bad || back > n || out.size() - n < length) return false;
            for (std::size_t j = 0; j < length; ++j, ++n) out[n] = out[n - back];
        }
    }

    bool code_lengths(std::uint8_t* lengths, unsigned& literals, unsigned& distances) {
        static constexpr std::uint8_t order[19] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
        literals = take(5) + 257;
        distances = take(5) + 1;
        const unsigned count = take(4) + 4;
        if (bad || literals > 286 || distances > 30) return false;
        std::uint8_t first[19] = {};
        for (unsigned i = 0; i < count; ++i) first[order[i]] = std::uint8_t(take(3));
        if (bad || !build(literal, first, 19, false)) return false;
        for (unsigned i = 0; i < literals + distances;) {
            const unsigned s = symbol(literal);
            if (s > 18) return false;
            if (s < 16) {
                lengths[i++] = std::uint8_t(s);
                continue;
            }
            const std::uint8_t value = s == 16 && i > 0 ? lengths[i - 1] : std::uint8_t(0);
            const unsigned times = s == 16 ? 3 + take(2) : s == 17 ? 3 + take(3) : 11 + take(7);
            if (bad || (s == 16 && i == 0) || i + times > literals + distances) return false;
            for (unsigned j = 0; j < times; ++j) lengths[i++] = value;
        }
        return lengths[256] != 0;  // without an end the block would have none
    }

    const std::uint8_t* in;
    std::size_t size, at = 0;
    std::uint64_t buffer = 0;
    unsigned held = 0, invented = 0;  // bits in the buffer; bytes of them that are not in the data
    bool bad = false;
    Code literal, distance;
};

// ---------------------------------------------------------------------------------------------------- header

// Parses JSON (RFC 8259) in ASCII without faith in its author: its depth, then its syntax, then its keys and numbers.
class Json {
  public:
    Json(const char* data, std::size_t count) noexcept : text(data), size(count) {}

    bool parse(Value& value) {
        if (!shallow()) return false;
        for (std::size_t i = 0; i < size; ++i)
            if (static_cast<unsigned char>(text[i]) > 127) return fail("HEADER_JSON", "not ASCII", i);
        blanks();
        if (!any(value)) return false;
        blanks();
        if (at != size) return fail("HEADER_JSON", "something follows the object", at);
        if (value.type != Value::Type::object) return fail("HEADER_JSON", "the header is not a JSON object", 0);
        if (twice < size) return fail("HEADER_DUPLICATE_KEY", "an object has a key twice", twice);
        if (beyond < size) return fail("HEADER_NUMBER", "a number does not fit 64 bits", beyond);
        return true;
    }

    const char *code = "", *message = "";
    std::size_t place = 0;

  private:
    // Whether no more than 32 brackets are open at once outside strings, whatever else is wrong with the text.
    bool shallow() noexcept {
        long long open = 0;
        bool quoted = false;
        for (std::size_t i = 0; i < size; ++i) {
            const char c = text[i];
            if (quoted && c == '\\')
                ++i;
            else if (c == '"')
                quoted = !quoted;
            else if (!quoted && (c == '[' || c == '{') && ++open > 32)
                return fail("HEADER_DEPTH", "nested deeper than 32", i);
            else if (!quoted && (c == ']' || c == '}'))
                --open;
        }
        return true;
    }

    bool fail(const char* rule, const char* what, std::size_t where) noexcept {
        code = rule;
        message = what;
        place = where;
        return false;
    }

    bool syntax() noexcept { return fail("HEADER_JSON", "the syntax is broken here", at); }

    char peek() const noexcept { return at < size ? text[at] : '\0'; }

    void blanks() noexcept {
        while (at < size && (text[at] == ' ' || text[at] == '\t' || text[at] == '\n' || text[at] == '\r')) ++at;
    }

    bool literal(const char* expected) noexcept {
        const std::size_t n = std::strlen(expected);
        if (size - at < n || std::memcmp(text + at, expected, n) != 0) return syntax();
        at += n;
        return true;
    }

    bool any(Value& value) {
        switch (peek()) {
            case '{': return object(value);
            case '[': return array(value);
            case '"': value.type = Value::Type::text; return string(value.text);
            case 't': value.type = Value::Type::boolean; value.truth = true; return literal("true");
            case 'f': value.type = Value::Type::boolean; return literal("false");
            case 'n': return literal("null");
            default: return number(value);
        }
    }

    bool array(Value& value) {
        value.type = Value::Type::array;
        ++at;
        blanks();
        if (peek() == ']') return ++at, true;
        for (;;) {
            value.items.emplace_back();
            if (!any(value.items.back())) return false;
            blanks();
            if (peek() == ']') return ++at, true;
            if (peek() != ',') return syntax();
            ++at;
            blanks();
        }
    }

    bool object(Value& value) {
        value.type = Value::Type::object;
        const std::size_t begin = at++;
        blanks();
        if (peek() == '}') return ++at, true;
        for (;;) {
            if (peek() != '"') return syntax();
            value.keys.emplace_back();
            if (!string(value.keys.back())) return false;
            blanks();
            if (peek() != ':') return syntax();
            ++at;
            blanks();
            value.items.emplace_back();
            if (!any(value.items.back())) return false;
            blanks();
            if (peek() == '}') break;
            if (peek() != ',') return syntax();
            ++at;
            blanks();
        }
        ++at;
        std::vector<const std::string*> sorted;
        for (const std::string& key : value.keys) sorted.push_back(&key);
        const auto less = [](const std::string* a, const std::string* b) { return *a < *b; };
        std::sort(sorted.begin(), sorted.end(), less);
        for (std::size_t i = 1; i < sorted.size(); ++i)
            if (*sorted[i - 1] == *sorted[i]) twice = (std::min)(twice, begin);
        return true;
    }

    // Reads the four digits of a \u escape.
    bool unit(unsigned& value) noexcept {
        value = 0;
        for (int i = 0; i < 4; ++i, ++at) {
            const char c = peek();
            const int digit = c >= '0' && c <= '9' ? c - '0' : c >= 'a' && c <= 'f' ? c - 'a' + 10
                                                           : c >= 'A' && c <= 'F'   ? c - 'A' + 10
                                                                                    : -1;
            if (digit < 0) return syntax();
            value = value * 16 + unsigned(digit);
        }
        return true;
    }

    bool string(std::string& value) {
        ++at;
        for (;;) {
            if (at >= size || static_cast<unsigned char>(text[at]) < 32) return syntax();
            const char c = text[at++];
            if (c == '"') return true;
            if (c != '\\') {
                value += c;
                continue;
            }
            const char escape = peek();
            ++at;
            static constexpr char from[] = "\"\\/bfnrt", to[] = "\"\\/\b\f\n\r\t";
            if (const char* found = escape != '\0' ? std::strchr(from, escape) : nullptr) {
                value += to[found - from];
                continue;
            }
            unsigned code_point = 0, low = 0;
            if (escape != 'u' || !unit(code_point)) return syntax();
            if (code_point >= 0xd800 && code_point < 0xe000) {
                if (code_point >= 0xdc00 || !(size - at >= 6 && text[at] == '\\' && text[at + 1] == 'u'))
                    return fail("HEADER_JSON", "half a surrogate pair", at);
                at += 2;
                if (!unit(low)) return false;
                if (low < 0xdc00 || low >= 0xe000) return fail("HEADER_JSON", "half a surrogate pair", at);
                code_point = 0x10000 + ((code_point - 0xd800) << 10) + (low - 0xdc00);
            }
            if (code_point < 0x80) {
                value += char(code_point);
            } else {
                const int more = code_point < 0x800 ? 1 : code_point < 0x10000 ? 2 : 3;
                value += char((more == 1 ? 0xc0 : more == 2 ? 0xe0 : 0xf0) | int(code_point >> (6 * more)));
                for (int i = more - 1; i >= 0; --i) value += char(0x80 | int(code_point >> (6 * i) & 63));
            }
        }
    }

    bool digits(std::string& into) {
        const std::size_t begin = at;
        while (peek() >= '0' && peek() <= '9') into += text[at++];
        return at > begin;
    }

    bool number(Value& value) {
        const std::size_t begin = at;
        value.type = Value::Type::number;
        // The fraction is moved into the exponent: a decimal point would make strtod depend on the locale
        std::string plain, exponent;
        if (peek() == '-') plain += text[at++];
        if (peek() == '0')
            plain += text[at++];
        else if (!digits(plain))
            return syntax();
        value.whole = true;
        long long shift = 0;
        if (peek() == '.' && at + 1 < size && text[at + 1] >= '0' && text[at + 1] <= '9') {
            const std::size_t point = at++;
            digits(plain);
            shift = -static_cast<long long>(at - point - 1);
            value.whole = false;
        }
        if (peek() == 'e' || peek() == 'E') {
            ++at;
            const bool negative = peek() == '-';
            if (negative || peek() == '+') ++at;
            if (!digits(exponent)) return syntax();
            long long power = 0;
            for (char c : exponent) power = (std::min)(power * 10 + (c - '0'), 100000000LL);
            shift += negative ? -power : power;
            value.whole = false;
        }
        if (value.whole) {
            const bool negative = plain[0] == '-';
            std::uint64_t magnitude = 0;
            if (plain.size() > 20) return unfit(begin);
            for (std::size_t i = negative ? 1 : 0; i < plain.size(); ++i) {
                if (magnitude > (std::uint64_t(1) << 63) / 10) return unfit(begin);
                magnitude = magnitude * 10 + std::uint64_t(plain[i] - '0');
            }
            if (magnitude >= std::uint64_t(1) << 63) return unfit(begin);
            value.integer = negative ? -std::int64_t(magnitude) : std::int64_t(magnitude);
            value.number = double(value.integer);
            return true;
        }
        value.number = std::strtod((plain + "e" + std::to_string(shift)).c_str(), nullptr);
        return finite(value.number) || unfit(begin);
    }

    // Keeps the place of a number that is too large; the syntax of what follows counts first.
    bool unfit(std::size_t begin) noexcept {
        beyond = (std::min)(beyond, begin);
        return true;
    }

    const char* text;
    std::size_t size, at = 0;
    std::size_t twice = std::size_t(-1), beyond = std::size_t(-1);
};

// What a value of the header must be.
enum class Kind : std::uint8_t {
    any, object, line, line_or_null, one_of, number, number_or_null, integer, integer_or_null, boolean, sha256,
    sha256_or_null, lines, moments, edges
};

struct Key {
    const char* name;
    Kind kind;
    double low = -std::numeric_limits<double>::infinity();  // least number
    bool above = false;                                     // it must be exceeded
    double high = std::numeric_limits<double>::infinity();
    const char* words = "";  // what `one_of` allows, between bars
};

using Keys = std::initializer_list<Key>;

inline bool is_line(const std::string& text) noexcept {
    std::size_t length = 0;
    for (std::size_t i = 0; i < text.size(); ++i) {
        const auto c = static_cast<unsigned char>(text[i]);
        if (c < 32 || c == 127) return false;
        if (c == 0xc2 && static_cast<unsigned char>(text[i + 1]) < 0xa0) return false;  // U+0080 to U+009F
        if ((c & 0xc0) != 0x80) ++length;
    }
    return length <= 4096;
}

inline bool is_digest(const std::string& text) noexcept {
    return text.size() == 64 && text.find_first_not_of("0123456789abcdef") == std::string::npos;
}

inline bool is_number(const Value& v, const Key& key) noexcept {
    return v.type == Value::Type::number && (key.above ? v.number > key.low : v.number >= key.low) &&
           v.number <= key.high;
}

inline bool obeys(const Value& v, const Key& key) {
    using Type = Value::Type;
    const bool null = v.type == Type::null, text = v.type == Type::text, array = v.type == Type::array;
    const auto all = [&v](auto rule) { return std::all_of(v.items.begin(), v.items.end(), rule); };
    switch (key.kind) {
        case Kind::any: return true;
        case Kind::object: return v.type == Type::object;
        case Kind::line: return text && is_line(v.text);
        case Kind::line_or_null: return null || (text && is_line(v.text));
        case Kind::one_of:
            return text && v.text.find('|') == std::string::npos &&
                   std::string(key.words).find("|" + v.text + "|") != std::string::npos;
        case Kind::number: return is_number(v, key);
        case Kind::number_or_null: return null || is_number(v, key);
        case Kind::integer: return v.whole && is_number(v, key);
        case Kind::integer_or_null: return null || (v.whole && is_number(v, key));
        case Kind::boolean: return v.type == Type::boolean;
        case Kind::sha256: return text && is_digest(v.text);
        case Kind::sha256_or_null: return null || (text && is_digest(v.text));
        case Kind::lines:
            return array && double(v.items.size()) <= key.high &&
                   all([](const Value& item) { return item.type == Type::text && is_line(item.text); });
        case Kind::moments:
            return array && v.items.size() == 17 && all([&key](const Value& item) { return is_number(item, key); });
        case Kind::edges:
            return array && v.items.size() >= 2 && v.items.size() <= 65537 &&
                   all([&key](const Value& item) { return is_number(item, key); });
    }
    return false;
}

constexpr double inf = std::numeric_limits<double>::infinity();
constexpr double largest = 1e30;                        // magnitude of any number but integers
constexpr double slack = 1e-9, upmost = 1.000000001;    // statistics are sums of many numbers, and rounded
constexpr double below_one = 0x1.fffffffffffffp-1;

// The blocks of version 1.1 in their order.
namespace which {
enum : int {
    p_theta, p_phi, p_r, p_z, p_l, mean_l,
    joint_r, joint_z, joint_phi_delta, joint_l, joint_entry_b2, joint_entry_azimuth,
    memory_hit, memory_cos_theta, memory_entry_azimuth, memory_r, memory_z, memory_phi_delta, memory_l, memory_entry_b2,
    count
};
}  // namespace which
// Joint records begin after the blocks that are required; what is new in 1.1, records by entry, after those.
constexpr int block_names = which::count, required_blocks = which::joint_r, old_blocks = which::memory_hit;

inline const char* block_name(int i) noexcept {
    static constexpr const char* names[block_names] = {
        "p_theta", "p_phi",   "p_r",             "p_z",     "p_l",            "mean_l",
        "joint_r", "joint_z", "joint_phi_delta", "joint_l", "joint_entry_b2", "joint_entry_azimuth",
        "memory_hit", "memory_cos_theta", "memory_entry_azimuth", "memory_r", "memory_z", "memory_phi_delta",
        "memory_l", "memory_entry_b2"};
    return names[i];
}

// Reads one file from memory; the rules are checked in the order that section 9 of SPEC.md gives.
class Reader {
  public:
    Reader(const std::uint8_t* bytes, std::size_t count, Table& into, Result& report) noexcept
        : data(bytes), size(count), table(into), result(report) {}

    bool read() {
        return attributes() && header() && version() && digest() && window() && schema() && manifest() && chunks() &&
               values();
    }

  private:
    struct Attribute {
        std::string name, type;
        std::size_t at = 0, size = 0;
    };

    bool fail(const char* code, const std::string& what, const std::string& place) {
        const std::string rule = code;
        const char* way_out = "what wrote the file does not follow SPEC.md, build it again with tsdf-build";
        if (rule == "EXR_TRUNCATED" || rule == "HASH_FILE")
            way_out = "the file is damaged or truncated, fetch or build it again";
        else if (rule == "EXR_MAGIC" || rule == "EXR_VERSION" || rule == "EXR_NOT_TSDF")
            way_out = "name a .tsdf.exr file made by tsdf-build";
        else if (rule == "VERSION_MAJOR" || rule == "VERSION_FEATURE")
            way_out = "use a newer tsdf.hpp";
        result.code = rule;
        result.place = place;
        result.message = what + "; " + way_out;
        return false;
    }

    static std::string at_byte(std::size_t at) { return "bytes " + std::to_string(at); }

    bool cut(std::size_t at) { return fail("EXR_TRUNCATED", "the file ends too early", at_byte(at)); }

    // Reads a name of at most 31 bytes and the zero byte that ends it.
    bool name(std::size_t& at, std::string& into) {
        const std::size_t most = (std::min)(std::size_t(32), size - at);
        const void* end = most > 0 ? std::memchr(data + at, 0, most) : nullptr;
        if (end == nullptr)
            return most < 32 ? cut(at) : fail("EXR_ATTRIBUTE", "a name is longer than 31 characters", at_byte(at));
        into = reinterpret_cast<const char*>(data + at);
        at += into.size() + 1;
        return true;
    }

    bool attributes() {
        static constexpr std::uint8_t magic[] = {0x76, 0x2f, 0x31, 0x01}, two[] = {2, 0, 0, 0};
        if (size < 4 || std::memcmp(data, magic, 4) != 0) return fail("EXR_MAGIC", "not an OpenEXR file", "bytes 0");
        if (size < 8) return cut(size);
        if (std::memcmp(data + 4, two, 4) != 0)
            return fail("EXR_VERSION", "the version field is not 02 00 00 00", "bytes 4");
        for (std::size_t at = 8;;) {
            Attribute made;
            const std::size_t begin = at;
            if (!name(at, made.name)) return false;
            if (made.name.empty()) {
                header_end = at;
                return true;
            }
            if (!name(at, made.type)) return false;
            if (size - at < 4) return cut(at);
            made.size = word(data + at);
            at += 4;
            if (made.size > std::size_t(1) << 20)
                return fail(made.name == "tsdf" ? "HEADER_SIZE" : "EXR_ATTRIBUTE",
                            "an attribute is longer than 2^20 bytes", at_byte(begin));
            if (attribute(made.name.c_str()) != nullptr || found.size() == 128 || made.type.empty())
                return fail("EXR_ATTRIBUTE", "an attribute is there twice, one too many or has no type",
                            at_byte(begin));
            if (size - at < made.size) return cut(at);
            made.at = at;
            at += made.size;
            found.push_back(std::move(made));
        }
    }

    const Attribute* attribute(const char* wanted) const noexcept {
        for (const Attribute& one : found)
            if (one.name == wanted) return &one;
        return nullptr;
    }

    bool header() {
        const Attribute* text = attribute("tsdf");
        if (text == nullptr || text->type != "string")
            return fail("EXR_NOT_TSDF", "an OpenEXR image, but not a TSDF", "bytes 8");
        Json json(reinterpret_cast<const char*>(data + text->at), text->size);
        return json.parse(table.header) || fail(json.code, json.message, at_byte(text->at + json.place));
    }

    static bool decimal(const std::string& text) noexcept {
        return !text.empty() && text.find_first_not_of("0123456789") == std::string::npos &&
               (text.size() == 1 || text[0] != '0');
    }

    bool version() {
        const Value *format = table.header.find("format"), *number = table.header.find("format_version");
        const std::string text = number != nullptr && number->type == Value::Type::text ? number->text : "";
        const std::size_t point = (std::min)(text.find('.'), text.size());
        const std::string major = text.substr(0, point), minor = text.substr((std::min)(point + 1, text.size()));
        if (!decimal(major) || !decimal(minor))
            return fail("VERSION_SYNTAX", "format_version is not MAJOR.MINOR", "/format_version");
        if (format == nullptr || format->type != Value::Type::text || format->text != "tsdf")
            return fail("VERSION_SYNTAX", "format is not \"tsdf\"", "/format");
        const std::string known = std::to_string(format_major) + "." + std::to_string(format_minor);
        if (major != std::to_string(format_major))
            return fail("VERSION_MAJOR", "the file is of another major version than " + known + ", which this reads",
                        "/format_version");
        const Value* features = table.header.find("required_features");
        if (features != nullptr && features->type == Value::Type::array && !features->items.empty())
            return fail("VERSION_FEATURE", "the file needs a feature that is unknown here", "/required_features/0");
        old = minor == "0";
        newer = !old && minor != std::to_string(format_minor);
        if (newer)
            result.warnings.push_back({"VERSION_MINOR", "/format_version",
                                       "the format version is newer than " + known + ", and what is new is ignored"});
        return true;
    }

    bool digest() {
        const Attribute* stated = attribute("tsdf_sha256");
        const std::string place = at_byte(stated != nullptr ? stated->at : 8);
        const std::string digits =
            stated != nullptr ? std::string(reinterpret_cast<const char*>(data + stated->at), stated->size) : "";
        if (stated == nullptr || stated->type != "string" || !is_digest(digits))
            return fail("HASH_MISSING", "tsdf_sha256 is missing or not 64 lower-case hexadecimal digits", place);
        Sha256 sha;
        const std::string zeros(64, '0');
        sha.add(data, stated->at);
        sha.add(reinterpret_cast<const std::uint8_t*>(zeros.data()), 64);
        sha.add(data + stated->at + 64, size - stated->at - 64);
        return sha.digits() == digits ||
               fail("HASH_FILE", "the bytes of the file do not match its digest", place);
    }

    bool window() {
        struct Fixed {
            const char *name, *type, *code;
            std::size_t size;
            const char* value;
        };
        static constexpr Fixed fixed[] = {
            {"channels", "chlist", "EXR_CHANNEL", 19, "Y\0\2\0\0\0\0\0\0\0\1\0\0\0\1\0\0\0"},
            {"compression", "compression", "EXR_COMPRESSION", 1, "\3"},
            {"lineOrder", "lineOrder", "EXR_LINE_ORDER", 1, ""},
            {"pixelAspectRatio", "float", "EXR_ATTRIBUTE", 4, "\0\0\x80\x3f"},
            {"screenWindowCenter", "v2f", "EXR_ATTRIBUTE", 8, "\0\0\0\0\0\0\0"},
            {"screenWindowWidth", "float", "EXR_ATTRIBUTE", 4, "\0\0\x80\x3f"},
            {"type", "string", "EXR_ATTRIBUTE", 13, "scanlineimage"}};
        for (const Fixed& one : fixed) {
            const Attribute* got = attribute(one.name);
            if (got == nullptr || got->type != one.type || got->size != one.size ||
                std::memcmp(data + got->at, one.value, one.size) != 0)
                return fail(one.code, std::string("attribute ") + one.name + " is missing or not what it must be",
                            at_byte(got != nullptr ? got->at : 8));
        }
        const Attribute *own = attribute("dataWindow"), *shown = attribute("displayWindow");
        for (const Attribute* one : {own, shown})
            if (one == nullptr || one->type != "box2i" || one->size != 16)
                return fail("EXR_WINDOW", "a window is missing or malformed", "bytes 8");
        const std::uint8_t* box = data + own->at;
        const std::uint32_t right = word(box + 8), bottom = word(box + 12);
        if (std::memcmp(box, data + shown->at, 16) != 0 || word(box) != 0 || word(box + 4) != 0 ||
            right > 0x7fffffff || bottom > 0x7fffffff)  // negative
            return fail("EXR_WINDOW", "the windows differ, are empty or do not begin at 0, 0", at_byte(own->at));
        if (right > 65535 || bottom > 65535 || std::uint64_t(right + 1) * (bottom + 1) > std::uint64_t(1) << 26)
            return fail("EXR_SIZE", "the image has more pixels than a table can have", at_byte(own->at));
        table.columns = right + 1;
        table.rows = bottom + 1;
        return true;
    }

    bool broken(const std::string& what, const std::string& place) { return fail("HEADER_SCHEMA", what, place); }

    // Whether `v` has all the keys with the values they must have, and no others.
    bool object(const Value& v, const std::string& place, Keys keys, bool open = false) {
        if (v.type != Value::Type::object) return broken("not an object", place);
        for (const Key& key : keys) {
            const Value* value = v.find(key.name);
            if (value == nullptr) return broken(std::string("the key ") + key.name + " is missing", place);
            if (!obeys(*value, key)) return broken("not what it must be", place + "/" + key.name);
        }
        for (const std::string& key : v.keys) {
            const auto same = [&key](const Key& known) { return key == known.name; };
            if (!open && !newer && key.compare(0, 2, "x_") != 0 && std::none_of(keys.begin(), keys.end(), same))
                return broken("a key that is unknown", place);
        }
        return true;
    }

    bool schema() {
        const Value& h = table.header;
        if (!object(h, "", {{"format", Kind::any}, {"format_version", Kind::any},
                            {"required_features", Kind::lines, -inf, false, 64}, {"columns", Kind::object},
                            {"blocks", Kind::any}, {"pixels_sha256", Kind::sha256}, {"grain", Kind::object},
                            {"optics", Kind::object}, {"statistics", Kind::object}, {"standard_errors", Kind::object},
                            {"table_error", Kind::object}, {"factorisation_error", Kind::object},
                            {"fits", Kind::object}, {"energy_ledger", Kind::object}, {"provenance", Kind::object},
                            {"licence", Kind::line}}) ||
            !object(*h.find("columns"), "/columns",
                    {{"quantity", Kind::one_of, 0, false, 0, "|cos_theta|"},
                     {"edges", Kind::edges, -largest, false, largest}}))
            return false;
        const Value& blocks = *h.find("blocks");
        if (blocks.type != Value::Type::array || blocks.items.empty() || blocks.items.size() > 64)
            return broken("not 1 to 64 blocks", "/blocks");
        for (std::size_t i = 0; i < blocks.items.size(); ++i)
            if (!block_schema(blocks.items[i], "/blocks/" + std::to_string(i))) return false;

        const Value& grain = *h.find("grain");
        if (!object(grain, "/grain",
                    {{"kind", Kind::one_of, 0, false, 0, "|sphere|mesh|"}, {"name", Kind::line},
                     {"parameters", Kind::object}, {"bounding_radius", Kind::number, 0, true, largest},
                     {"area", Kind::number, 0, true, largest}, {"volume", Kind::number, 0, true, largest},
                     {"convex", Kind::boolean}, {"bodies", Kind::integer, 1}, {"faces", Kind::integer, 0},
                     {"mesh_sha256", Kind::sha256_or_null},
                     {"notes", Kind::lines, -inf, false, 256}}))
            return false;
        if (grain.find("parameters")->items.size() > 256) return broken("more than 256 keys", "/grain/parameters");
        const Value& optics = *h.find("optics");
        if (!object(optics, "/optics",
                    {{"eta", Kind::number, 1e-30, false, largest}, {"fresnel", Kind::one_of, 0, false, 0, "|un|sp|"},
                     {"material", Kind::line_or_null}, {"wavelength_nm", Kind::number_or_null, 0, true, largest},
                     {"k", Kind::number_or_null, 0, false, largest}, {"source", Kind::line_or_null}}))
            return false;
        table.bounding_radius = grain.find("bounding_radius")->number;
        table.eta = optics.find("eta")->number;

        const auto stated = [](const char* key) { return Key{key, Kind::number, 0, false, largest}; };
        if (!statistics(*h.find("statistics"), "/statistics", false, table.statistics) ||
            !statistics(*h.find("standard_errors"), "/standard_errors", true, table.standard_errors) ||
            !object(*h.find("table_error"), "/table_error",
                    {stated("total_variation"), stated("sampling_noise"), stated("cell_width")}))
            return false;
        const Value& factors = *h.find("factorisation_error");
        const std::string place = "/factorisation_error";
        const auto bits = [](const char* key) { return Key{key, Kind::number, -largest, false, largest}; };
        if (!object(factors, place,
                    {{"mutual_information_bits", Kind::object}, stated("total_variation"),
                     stated("total_variation_noise"), stated("impossible_offsets"), stated("mean_offset"),
                     stated("mean_offset_factorised"), {"resolution", Kind::object}}) ||
            !object(*factors.find("mutual_information_bits"), place + "/mutual_information_bits",
                    {bits("r_z"), bits("r_phi"), bits("z_phi"), bits("r_l"), bits("z_l"), bits("phi_l")}) ||
            !object(*factors.find("resolution"), place + "/resolution",
                    {{"theta", Kind::integer, 1, false, 65536}, {"phi", Kind::integer, 1, false, 65536},
                     {"r", Kind::integer, 1, false, 65536}, {"z", Kind::integer, 1, false, 65536},
                     {"l", Kind::integer, 1, false, 65536}}))
            return false;
        const Value& fits = *h.find("fits");
        const auto lobe = [](const char* key) { return Key{key, Kind::number, -1, true, below_one}; };
        return object(fits, "/fits", {{"henyey_greenstein", Kind::object}, {"two_lobe", Kind::object}}) &&
               object(*fits.find("henyey_greenstein"), "/fits/henyey_greenstein",
                      {lobe("g"), stated("total_variation")}) &&
               object(*fits.find("two_lobe"), "/fits/two_lobe",
                      {lobe("g1"), lobe("g2"), {"weight", Kind::number, 0, false, 1}, stated("total_variation")}) &&
               object(*h.find("energy_ledger"), "/energy_ledger",
                      {{"launched", Kind::integer, 0}, {"unscattered", Kind::integer, 0},
                       {"scattered", Kind::integer, 0}, {"absorbed", Kind::integer, 0},
                       {"truncated", Kind::integer, 0}, {"lost", Kind::integer, 0}}) &&
               object(*h.find("provenance"), "/provenance",
                      {{"software", Kind::line}, {"method", Kind::one_of, 0, false, 0, "|exact|traced|"},
                       {"command", Kind::line}, {"seed", Kind::integer_or_null}, {"paths", Kind::integer, 0},
                       {"max_bounces", Kind::integer_or_null, 0}});
    }

    bool block_schema(const Value& v, const std::string& place) {
        const Key name{"name", Kind::line}, first{"first_row", Kind::integer, 0, false, 65535},
            rows{"rows", Kind::integer, 1, false, 65536}, edges{"edges", Kind::edges, -largest, false, largest};
        if (!object(v, place, {name, first, rows}, true)) return false;
        const std::string& text = v.find("name")->text;
        if (text.empty() || text.size() > 64 ||
            text.find_first_not_of("abcdefghijklmnopqrstuvwxyz0123456789_") != std::string::npos)
            return broken("not a name", place + "/name");
        const auto word_of = [](const char* key, const char* words) {
            return Key{key, Kind::one_of, 0, false, 0, words};
        };
        const int i = known(text);
        if (i < 0) return true;
        if (i == 0) {
            const Key one{"rows", Kind::integer, 1, false, 1};
            return object(v, place, {name, first, one, word_of("kind", "|mass|")});
        }
        if (i == 5)
            return object(v, place, {name, first, rows, word_of("kind", "|mean|"), word_of("of", "|p_l|"),
                                     word_of("unit", "|R|")});
        if (i == old_blocks) {
            const Key one{"rows", Kind::integer, 1, false, 1};
            return object(v, place, {name, first, one, word_of("kind", "|probability|")});
        }
        static constexpr const char* unit[block_names] = {
            "", "|rad|", "|R|", "|R|", "|R|", "", "|R|", "|R|", "|rad|", "|R|", "|R^2|", "|rad|",
            "", "|1|", "|rad|", "|R|", "|R|", "|rad|", "|R|", "|R^2|"};
        if (i > 5) return object(v, place, {name, first, rows, word_of("kind", "|record|"), word_of("unit", unit[i])});
        static constexpr const char* quantity[] = {"", "|phi_delta|", "|r|", "|z|", "|l|"};
        return object(v, place, {name, first, rows, word_of("kind", "|mass|"), word_of("quantity", quantity[i]),
                                 word_of("unit", unit[i]), edges});
    }

    bool statistics(const Value& v, const std::string& place, bool errors, Statistics& into) {
        const auto within = [errors](const char* name, double low, double high, bool above = false) {
            return errors ? Key{name, Kind::number, 0, false, largest} : Key{name, Kind::number, low, above, high};
        };
        const Key moments = errors ? Key{"legendre_moments", Kind::moments, 0, false, largest}
                                   : Key{"legendre_moments", Kind::moments, -upmost, false, upmost};
        if (!object(v, place,
                    {within("hit_probability", 0, upmost, true), within("albedo", 0, upmost, true),
                     within("mean_cosine", -upmost, upmost), within("mean_z", -upmost, 2.000000001),
                     within("mean_r", -slack, 2.000000001), within("mean_miss_chord", -slack, 2.000000001),
                     within("mean_path_length", 0, largest), within("atom_forward", -slack, upmost),
                     within("atom_backward", -slack, upmost), moments}))
            return false;
        const auto number = [&v](const char* key) { return v.find(key)->number; };
        into.hit_probability = number("hit_probability");
        into.albedo = number("albedo");
        into.mean_cosine = number("mean_cosine");
        into.mean_z = number("mean_z");
        into.mean_r = number("mean_r");
        into.mean_miss_chord = number("mean_miss_chord");
        into.mean_path_length = number("mean_path_length");
        into.atom_forward = number("atom_forward");
        into.atom_backward = number("atom_backward");
        for (std::size_t i = 0; i < 17; ++i) into.legendre_moments[i] = v.find("legendre_moments")->items[i].number;
        return true;
    }

    // Number of a block of version 1.1, -1 for any other.
    static int known(const std::string& name) noexcept {
        for (int i = 0; i < block_names; ++i)
            if (name == block_name(i)) return i;
        return -1;
    }

    Block& block(int i) noexcept {
        Block* const all[block_names] = {
            &table.p_theta, &table.p_phi,   &table.p_r,             &table.p_z,     &table.p_l,            &table.mean_l,
            &table.joint_r, &table.joint_z, &table.joint_phi_delta, &table.joint_l, &table.joint_entry_b2,
            &table.joint_entry_azimuth, &table.memory_hit, &table.memory_cos_theta, &table.memory_entry_azimuth,
            &table.memory_r, &table.memory_z, &table.memory_phi_delta, &table.memory_l, &table.memory_entry_b2};
        return *all[i];
    }

    bool manifest() {
        const Value& ledger = *table.header.find("energy_ledger");
        std::int64_t rest = ledger.find("launched")->integer;
        for (const char* key : {"unscattered", "scattered", "absorbed", "truncated", "lost"}) {
            const std::int64_t part = ledger.find(key)->integer;
            if (part > rest) {
                rest = -1;
                break;
            }
            rest -= part;
        }
        if (rest != 0)
            return fail("HEADER_LEDGER", "launched is not the sum of the others", "/energy_ledger/launched");
        const std::int64_t launched = ledger.find("launched")->integer;
        const std::int64_t met = launched - ledger.find("unscattered")->integer;
        const std::int64_t scattered = ledger.find("scattered")->integer;
        const auto share = [](double stated, std::int64_t part, std::int64_t whole) {
            const double expected = stated * double(whole);
            return part > 0 && std::abs(expected - double(part)) <= 1e-3 * expected;
        };
        if (!share(table.statistics.hit_probability, met, launched))
            return fail("HEADER_STATISTICS", "hit_probability is not that of the energy ledger",
                        "/statistics/hit_probability");
        if (!share(table.statistics.albedo, scattered, met))
            return fail("HEADER_STATISTICS", "albedo is not that of the energy ledger", "/statistics/albedo");

        const std::vector<Value>& blocks = table.header.find("blocks")->items;
        std::size_t next = 0;
        std::vector<int> order;
        for (std::size_t i = 0; i < blocks.size(); ++i) {
            const std::string place = "/blocks/" + std::to_string(i), &name = blocks[i].find("name")->text;
            const auto first = std::size_t(blocks[i].find("first_row")->integer);
            const auto rows = std::size_t(blocks[i].find("rows")->integer);
            if (first != next) return fail("MANIFEST_ROWS", "not the row that is next", place + "/first_row");
            next = first + rows;
            for (std::size_t j = 0; j < i; ++j)
                if (blocks[j].find("name")->text == name)
                    return fail("MANIFEST_DUPLICATE", "a second block of this name", place + "/name");
            const int any = known(name), k = old && any >= old_blocks ? -1 : any;
            if (k < 0 && !newer)
                return fail("MANIFEST_UNKNOWN", "the version of the file has no such block", place + "/name");
            if (k < 0) continue;
            order.push_back(k);
            block(k).first_row = first;
            block(k).rows = rows;
            if (const Value* edges = k >= which::p_phi && k <= which::p_l ? blocks[i].find("edges") : nullptr)
                for (const Value& edge : edges->items) block(k).edges.push_back(edge.number);
        }
        if (next != table.rows)
            return fail("MANIFEST_HEIGHT", "the blocks have not as many rows as the image", "/blocks");
        for (int k = 0; k < required_blocks; ++k)
            if (block(k).rows == 0)
                return fail("MANIFEST_MISSING", std::string("there is no block ") + block_name(k), "/blocks");
        if (!std::is_sorted(order.begin(), order.end()))
            return fail("MANIFEST_ORDER", "the blocks are not in the order of the specification", "/blocks");
        if (table.mean_l.rows != table.p_l.rows)
            return fail("MANIFEST_MEAN", "mean_l has not as many rows as p_l", "/blocks");
        table.records = table.joint_r.rows;
        for (int k = required_blocks; k < old_blocks; ++k)
            if (block(k).rows != table.records)
                return fail("MANIFEST_RECORDS", "the joint blocks are not six of equal length", "/blocks");
        table.memory_records = table.memory_entry_b2.rows;
        for (int k = old_blocks; k < block_names; ++k)
            if (block(k).rows != (k > old_blocks ? table.memory_records : table.memory_records > 0 ? 1u : 0u))
                return fail("MANIFEST_MEMORY", "the memory blocks are not memory_hit and seven of equal length",
                            "/blocks");

        for (const Value& edge : table.header.find("columns")->find("edges")->items)
            table.cos_theta_edges.push_back(edge.number);
        const std::vector<double>& columns = table.cos_theta_edges;
        if (columns.size() != table.columns + 1)
            return fail("MANIFEST_WIDTH", "the image has not as many columns as there are cells", "/columns/edges");
        if (!axis(columns, "/columns/edges", columns.front() == -1.0 && columns.back() == 1.0, true, true))
            return false;
        for (std::size_t i = 0; i < blocks.size(); ++i) {
            const int k = known(blocks[i].find("name")->text);
            if (k < which::p_phi || k > which::p_l) continue;
            const std::string place = "/blocks/" + std::to_string(i) + "/edges";
            const std::vector<double>& edges = block(k).edges;
            if (edges.size() != block(k).rows + 1)
                return fail("MANIFEST_EDGE_COUNT", "not one edge more than rows", place);
            const double first = edges.front(), last = edges.back();
            const bool whole =
                k == which::p_phi ? -pi <= first && first <= 0.0 && std::abs(last - first - 2.0 * pi) <= 1e-9
                : k == which::p_r ? first == 0.0 && last == 2.0
                : k == which::p_z ? first == -1.0 && last == 2.0
                                  : first == 0.0;
            if (!axis(edges, place, whole, k == which::p_l, false)) return false;
        }
        return true;
    }

    // Whether edges span their axis and ascend, but for an atom in the first or the last cell.
    bool axis(const std::vector<double>& edges, const std::string& place, bool whole, bool atom, bool last_atom) {
        if (!whole) return fail("MANIFEST_EDGE_ENDS", "this is not the range of this axis", place);
        for (std::size_t i = 0; i + 1 < edges.size(); ++i) {
            const bool none = (atom && i == 0) || (last_atom && i + 2 == edges.size());
            if (none ? edges[i] != edges[i + 1] : !(edges[i + 1] - edges[i] >= 1e-30))
                return fail("MANIFEST_EDGE_ORDER", none ? "the width of this cell is not zero" : "edges do not ascend",
                            place + "/" + std::to_string(i + 1));
        }
        return true;
    }

    bool chunks() {
        const std::size_t count = (table.rows + 15) / 16;
        if (size - header_end < 8 * count) return cut(header_end);
        std::size_t at = header_end + 8 * count;
        Sha256 sha;
        Bytes plain, woven;
        // Not more than the bytes that are there can inflate to
        table.pixels.reserve((std::min)(table.rows * table.columns, 1040 * (size - header_end) / 4));
        for (std::size_t i = 0; i < count; ++i) {
            const std::string place = at_byte(at);
            const auto bad = [&] { return fail("EXR_CHUNK", "a chunk is not what it should be", place); };
            const std::uint8_t* offset = data + header_end + 8 * i;
            if (word(offset) != at || word(offset + 4) != 0 || size - at < 8) return bad();
            const std::size_t length = word(data + at + 4);
            const std::size_t n = 4 * table.columns * (std::min)(std::size_t(16), table.rows - 16 * i);
            if (word(data + at) != 16 * i || length == 0 || length > n || size - at - 8 < length) return bad();
            const std::uint8_t* packed = data + at + 8;
            if (length == n) {
                woven.assign(packed, packed + n);
            } else {
                plain.resize(n);
                woven.resize(n);
                if (!Inflate(packed, length).run(plain)) return bad();
                for (std::size_t j = 1; j < n; ++j) plain[j] = std::uint8_t(plain[j - 1] + plain[j] - 128);
                for (std::size_t j = 0; j < n / 2; ++j) {
                    woven[2 * j] = plain[j];
                    woven[2 * j + 1] = plain[n / 2 + j];
                }
            }
            sha.add(woven.data(), n);
            const std::size_t before = table.pixels.size();
            table.pixels.resize(before + n / 4);
            for (std::size_t j = 0; j < n / 4; ++j) {
                const std::uint32_t bits = word(woven.data() + 4 * j);
                std::memcpy(&table.pixels[before + j], &bits, 4);
            }
            at += 8 + length;
        }
        if (at != size) return fail("EXR_TRAILING", "something follows the last chunk", at_byte(at));
        return sha.digits() == table.header.find("pixels_sha256")->text ||
               fail("HASH_PIXELS", "the pixels are not those announced", "/pixels_sha256");
    }

    // Fails at the first pixel of a block at which `bad(row of the block, column, value)`.
    template <class Bad>
    bool sound(int k, const char* code, const char* what, Bad bad) {
        for (std::size_t y = 0; y < block(k).rows; ++y)
            for (std::size_t x = 0; x < table.columns; ++x)
                if (bad(y, x, table.row(block(k).first_row + y)[x]))
                    return fail(code, std::string(block_name(k)) + ": " + what,
                                "row " + std::to_string(block(k).first_row + y) + ", column " + std::to_string(x));
        return true;
    }

    bool values() {
        using std::size_t;
        for (int k = 0; k < block_names; ++k)
            if (!sound(k, "VALUE_NOT_FINITE", "not finite", [](size_t, size_t, float v) { return !finite(double(v)); }))
                return false;
        for (int k = 0; k < required_blocks; ++k)
            if (!sound(k, "VALUE_NEGATIVE", "negative", [](size_t, size_t, float v) { return v < 0.0f; })) return false;
        const float* drawn = table.row(table.p_theta.first_row);
        double sum = 0.0;
        for (size_t x = 0; x < table.columns; ++x) sum += double(drawn[x]);
        if (std::abs(sum - 1.0) > 1e-5)
            return fail("VALUE_P_THETA_SUM", "p_theta does not sum to 1", "row 0, column 0");
        for (int k = which::p_phi; k <= which::p_l; ++k) {
            std::vector<double> sums(table.columns, 0.0);
            for (size_t y = 0; y < block(k).rows; ++y)
                for (size_t x = 0; x < table.columns; ++x) sums[x] += double(table.row(block(k).first_row + y)[x]);
            const auto off = [&](size_t y, size_t x, float) {
                return y == 0 && drawn[x] != 0.0f && std::abs(sums[x] - 1.0) > 1e-5;
            };
            if (!sound(k, "VALUE_COLUMN_SUM", "the column does not sum to 1", off)) return false;
        }
        for (int k = 0; k < old_blocks; ++k) {
            const auto filled = [&](size_t, size_t x, float v) { return drawn[x] == 0.0f && v != 0.0f; };
            if (!sound(k, "VALUE_EMPTY_COLUMN", "not 0 though p_theta is", filled)) return false;
        }
        const auto outside = [&](size_t y, size_t x, float value) {
            if (table.row(table.p_l.first_row + y)[x] == 0.0f) return value != 0.0f;
            const double mean = double(value), upper = y + 1 < table.p_l.rows ? table.p_l.edges[y + 1] : largest;
            return mean * (1.0 + 1e-6) < table.p_l.edges[y] || mean * (1.0 - 1e-6) > upper;
        };
        if (!sound(which::mean_l, "VALUE_MEAN_RANGE", "outside its cell or of no mass", outside)) return false;
        const Fields joint{which::joint_r, which::joint_z, which::joint_phi_delta, which::joint_entry_b2,
                           which::joint_entry_azimuth};
        return (table.records == 0 || records(required_blocks, old_blocks, joint)) &&
               (table.memory_records == 0 || memory()) && means();
    }

    // Whether the statistics are those that the masses of the cells allow, whatever lies where in a cell.
    bool means() {
        using std::size_t;
        const float* p = table.row(table.p_theta.first_row);
        const Statistics& s = table.statistics;
        const auto near = [&](const char* key, double stated, double low, double high, double unit_of = 1.0) {
            if (stated >= low - 0.02 * unit_of && stated <= high + 0.02 * unit_of) return true;
            return fail("VALUE_STATISTICS", std::string(key) + " is not that of the blocks",
                        std::string("/statistics/") + key);
        };
        // Least and largest mean that masses of cells allow
        const auto bounds = [](const std::vector<double>& edges, auto mass) {
            std::pair<double, double> made{0.0, 0.0};
            for (size_t i = 0; i + 1 < edges.size(); ++i) {
                made.first += edges[i] * mass(i);
                made.second += edges[i + 1] * mass(i);
            }
            return made;
        };
        const auto of_block = [&](const Block& b) {
            return bounds(b.edges, [&](size_t y) {
                double sum = 0.0;
                for (size_t x = 0; x < table.columns; ++x) sum += double(table.row(b.first_row + y)[x]) * double(p[x]);
                return sum;
            });
        };
        const auto cosine = bounds(table.cos_theta_edges, [&](size_t x) { return double(p[x]); });
        const auto r = of_block(table.p_r), z = of_block(table.p_z);
        double length = 0.0;
        for (size_t y = 0; y < table.p_l.rows; ++y)
            for (size_t x = 0; x < table.columns; ++x)
                length += double(table.row(table.p_l.first_row + y)[x]) *
                          double(table.row(table.mean_l.first_row + y)[x]) * double(p[x]);
        const double back = double(p[0]), forth = double(p[table.columns - 1]);
        return near("atom_backward", s.atom_backward, back, back) &&
               near("atom_forward", s.atom_forward, forth, forth) &&
               near("mean_cosine", s.mean_cosine, cosine.first, cosine.second) &&
               near("mean_r", s.mean_r, r.first, r.second) && near("mean_z", s.mean_z, z.first, z.second) &&
               near("mean_path_length", s.mean_path_length, length, length, (std::max)(1.0, length));
    }

    // Blocks that hold the fields of records of one kind.
    struct Fields {
        int r, z, phi_delta, entry_b2, entry_azimuth;
    };

    bool memory() {
        using std::size_t;
        const auto unlikely = [](size_t, size_t, float v) { return v < 0.0f || v > 1.0f; };
        const Fields fields{which::memory_r, which::memory_z, which::memory_phi_delta, which::memory_entry_b2,
                            which::memory_entry_azimuth};
        if (!sound(which::memory_hit, "VALUE_MEMORY_HIT", "not a probability", unlikely) ||
            !records(which::memory_hit + 1, block_names, fields))
            return false;
        const float* hit = table.row(table.memory_hit.first_row);
        const auto strays = [&](size_t, size_t x, float v) {
            const double low = double(x) / double(table.columns), high = low + 1.0 / double(table.columns);
            return hit[x] != 0.0f && (double(v) < low - 1e-6 || double(v) > high + 1e-6);
        };
        if (!sound(which::memory_entry_b2, "VALUE_MEMORY_CELL", "not of this column's cell", strays)) return false;
        const auto filled = [&](size_t, size_t x, float v) { return hit[x] == 0.0f && v != 0.0f; };
        for (int k = old_blocks + 1; k < block_names; ++k)
            if (!sound(k, "VALUE_MEMORY_EMPTY", "not 0 though memory_hit is", filled)) return false;
        return true;
    }

    // Least and largest value of a block of records.
    static std::pair<double, double> range(int k) noexcept {
        constexpr double turn = double(3.14159274f);  // pi as float32
        switch (k) {
            case which::joint_r: case which::memory_r: return {0.0, 2.0};
            case which::joint_z: case which::memory_z: return {-1.0, 2.0};
            case which::joint_phi_delta: case which::memory_phi_delta: return {-turn, turn};
            case which::joint_entry_azimuth: case which::memory_entry_azimuth: return {-turn, turn};
            case which::joint_l: case which::memory_l: return {0.0, largest};
            case which::memory_cos_theta: return {-1.0, 1.0};
            default: return {0.0, 1.0};  // entry_b2
        }
    }

    // Rules of the records in the blocks from `first` to before `end`.
    bool records(int first, int end, const Fields& of) {
        using std::size_t;
        for (int k = first; k < end; ++k) {
            const std::pair<double, double> allowed = range(k);
            const bool azimuth = k == which::joint_entry_azimuth;
            const auto outside = [&](size_t, size_t x, float v) {
                return double(v) < allowed.first - 1e-6 || double(v) > allowed.second + 1e-6 ||
                       (azimuth && v != 0.0f && (x == 0 || x + 1 == table.columns));
            };
            if (!sound(k, "VALUE_RECORD_RANGE", "out of range", outside)) return false;
        }
        const auto value = [&](int k, size_t y, size_t x) { return double(table.row(block(k).first_row + y)[x]); };
        const auto falls = [&](size_t y, size_t x, float v) {
            return y > 0 && double(v) < value(of.entry_b2, y - 1, x);
        };
        if (!sound(of.entry_b2, "VALUE_RECORD_ORDER", "smaller than the one before", falls)) return false;
        // With d_in along z and x_i at azimuth 0, phi_d is entry_azimuth and phi_p is phi_delta + phi_d
        const auto off = [&](size_t y, size_t x, float v) {
            const double r = double(v), z = value(of.z, y, x);
            const double b2 = (std::min)((std::max)(value(of.entry_b2, y, x), 0.0), 1.0);
            const double phi_p = value(of.phi_delta, y, x) + value(of.entry_azimuth, y, x);
            return std::abs(r * r + 2.0 * r * std::sqrt(b2) * std::cos(phi_p) + z * z - 2.0 * z * std::sqrt(1.0 - b2)) >
                   2e-3;
        };
        return sound(of.r, "VALUE_RECORD_SPHERE", "the exit is off the bounding sphere", off);
    }

    const std::uint8_t* data;
    std::size_t size;
    Table& table;
    Result& result;
    std::vector<Attribute> found;
    std::size_t header_end = 0;
    bool newer = false, old = false;
};

}  // namespace detail

// Reads a table from the bytes of a file. `table` is left empty if there is an error.
inline Result parse(const void* data, std::size_t size, Table& table) {
    Result result;
    table = Table();
    if (size > std::size_t(1) << 29) {
        result.code = "EXR_SIZE";
        result.place = "bytes 0";
        result.message = "more bytes than a table can have; name a .tsdf.exr file made by tsdf-build";
    } else if (!detail::Reader(static_cast<const std::uint8_t*>(data), size, table, result).read()) {
        table = Table();
    }
    return result;
}

// Reads a table from a file. `table` is left empty if there is an error; the message begins with the path.
inline Result load(const std::filesystem::path& path, Table& table) {
    Result result;
    table = Table();
    std::error_code error;
    const bool regular = std::filesystem::is_regular_file(path, error);
    const std::uintmax_t size = regular ? std::filesystem::file_size(path, error) : 0;
    if (regular && !error && size > std::uintmax_t(1) << 29) {
        result.code = "EXR_SIZE";
        result.place = "bytes 0";
        result.message = "more bytes than a table can have; name a .tsdf.exr file made by tsdf-build";
    } else {
        detail::Bytes bytes(static_cast<std::size_t>(regular && !error ? size : 0));
        std::ifstream file(path, std::ios::binary);
        if (!regular || error || !file ||
            (!bytes.empty() && !file.read(reinterpret_cast<char*>(bytes.data()), std::streamsize(bytes.size())))) {
            result.code = "FILE_UNREADABLE";
            result.message = "not a regular file that can be read; check the name and the permissions";
        } else {
            result = parse(bytes.data(), bytes.size(), table);
        }
    }
    std::string shown;
    for (char c : path.u8string()) shown += c >= ' ' && c < 127 ? c : '?';
    result.message = result.code.empty() ? "" : shown + ": " + result.message;
    for (Finding& warning : result.warnings) warning.message = shown + ": " + warning.message;
    return result;
}

// ------------------------------------------------------------------------------------------------------ sampling

// A scattering event; lengths in R, angles in radians.
struct Sample {
    double cos_theta;      // of the deflection
    double phi_d;          // azimuth of d_out about d_in, in [0, 2 pi)
    double r, z;           // parts of x_o - x_i across and along d_in
    double phi_delta;      // azimuth of x_o - x_i less that of d_out
    double path_length;    // inside the grain
    std::uint32_t column;  // of the table
};

struct Vector {
    double x, y, z;
};

// Where light leaves: direction of propagation, and x_o - x_i [R].
struct Outgoing {
    Vector d_out, offset;
};

// What drawing from one table needs, as plain arrays; docs/cpp.md says what is in each.
struct Sampler {
    static constexpr std::uint32_t one = std::uint32_t(1) << 31;  // what cumulative masses end with
    enum Axis : unsigned { axis_r, axis_z, axis_phi, axis_l, axes };

    std::uint32_t columns = 0, records = 0;            // records per column, 0 unless prepared for them
    std::uint32_t theta_bits = 0, bits = 0;            // the guides have 2^theta_bits and 2^bits entries
    std::array<std::uint32_t, axes + 1> start{};       // where each axis begins in `edges` and rows of `cumulative`
    double atom_backward = 0, atom_forward = 0;        // probabilities of exactly -1 and 1
    std::vector<double> theta;                         // columns + 1: cumulative masses of the columns, 0 to 1
    std::vector<std::uint16_t> theta_guide;            // column in which each of as many equal parts of [0, 1) begins
    std::vector<double> cos_theta;                     // columns + 1: edges
    std::vector<std::uint16_t> cos_theta_guide;        // column in which each equal part of [-1, 1] begins
    std::vector<double> per_steradian;                 // columns: density of d_out, 0 for the atoms
    std::vector<std::uint32_t> cumulative;             // columns x start[axes]: cumulative masses, each axis 0 to `one`
    std::vector<std::uint8_t> guide;                   // columns x axes x 2^bits: as theta_guide, within the axis
    std::uint32_t guide_shift = 0;                     // the guide is the cell >> this: 0 up to 256 cells
    std::vector<double> edges;                         // start[axes]: edges of the cells of each axis
    std::vector<float> record;                         // columns x records x 4: r, z, phi_delta, path length

    // Fills the arrays. Fails with SAMPLER_MASS if there is nothing to draw from, which no table that `load` has
    // passed lacks, and with SAMPLER_RECORDS if joint records are asked for and missing.
    Result prepare(const Table& table, bool joint = false);

    // The event that six numbers in [0, 1) stand for (Algorithm 1, lines 2 to 6); others are brought into that range.
    // Each result rises with its own number as long as the column stays.
    Sample sample(double u_phi_d, double u_theta, double u_r, double u_z, double u_phi_delta,
                  double u_length) const noexcept {
        Sample s;
        s.phi_d = 2.0 * pi * inside(u_phi_d);
        s.column = draw_column(inside(u_theta), s.cos_theta);
        s.r = draw(s.column, axis_r, inside(u_r));
        s.z = draw(s.column, axis_z, inside(u_z));
        s.phi_delta = draw(s.column, axis_phi, inside(u_phi_delta));
        s.path_length = draw(s.column, axis_l, inside(u_length));
        return s;
    }

    // As `sample`, but r, z, phi_delta and the path length are those of one joint record of the column, and so keep
    // their correlation. All four are 0 if not prepared for records.
    Sample sample_joint(double u_phi_d, double u_theta, double u_record) const noexcept {
        Sample s;
        s.phi_d = 2.0 * pi * inside(u_phi_d);
        s.column = draw_column(inside(u_theta), s.cos_theta);
        s.r = s.z = s.phi_delta = s.path_length = 0.0;
        if (records > 0) {
            const auto k = std::size_t(inside(u_record) * records);
            const float* p = record.data() + 4 * (std::size_t(s.column) * records + k);
            s.r = double(p[0]);
            s.z = double(p[1]);
            s.phi_delta = double(p[2]);
            s.path_length = double(p[3]);
        }
        return s;
    }

    // Density of d_out [1/sr] at a cosine, the atoms left out; 0 outside [-1, 1].
    double pdf_solid_angle(double cosine) const noexcept {
        if (!(cosine >= -1.0 && cosine <= 1.0) || columns < 3) return 0.0;
        const double parts = double(std::uint32_t(1) << theta_bits);
        const double part = (std::min)((cosine + 1.0) * 0.5 * parts, parts - 1.0);
        std::size_t k = cos_theta_guide[std::size_t(part)];
        while (k > 1 && cosine < cos_theta[k]) --k;  // the part is rounded
        while (k + 2 < columns && cosine >= cos_theta[k + 1]) ++k;
        return per_steradian[k];
    }

    // Density of cos theta, the atoms left out; its integral over [-1, 1] is 1 - atom_backward - atom_forward.
    double pdf(double cosine) const noexcept { return 2.0 * pi * pdf_solid_angle(cosine); }

    // Column of u in [0, 1), and the cosine that it stands for, rising with u.
    std::uint32_t draw_column(double u, double& cosine) const noexcept {
        const double* sums = theta.data();
        std::size_t k = theta_guide[std::size_t(std::uint32_t(u * one) >> (31 - theta_bits))];
        k += u >= sums[k + 1];  // most often enough, and costs the processor no guess
        while (u >= sums[k + 1]) ++k;
        const double low = cos_theta[k], high = cos_theta[k + 1];
        cosine = (std::min)(low + (u - sums[k]) / (sums[k + 1] - sums[k]) * (high - low), high);
        return std::uint32_t(k);
    }

    // Value on an axis of u in [0, 1), given the column, rising with u.
    double draw(std::uint32_t column, Axis axis, double u) const noexcept {
        const std::uint32_t* sums = cumulative.data() + std::size_t(column) * start[axes];
        const double x = u * one;
        const auto whole = std::uint32_t(x);
        std::size_t k = guide[((std::size_t(column) * axes + axis) << bits) | (whole >> (31 - bits))];
        k = (k << guide_shift) + start[axis];
        k += whole >= sums[k + 1];
        while (whole >= sums[k + 1]) ++k;
        const double low = edges[k], high = edges[k + 1];
        return (std::min)(low + (x - sums[k]) / (sums[k + 1] - sums[k]) * (high - low), high);
    }

    // A number brought into [0, 1); not a number becomes 0.
    static double inside(double u) noexcept {
        u = u > 0.0 ? u : 0.0;
        constexpr double most = 1.0 - std::numeric_limits<double>::epsilon() / 2.0;
        return u < most ? u : most;
    }

    // The arrays as one of 32-bit words for a shader; docs/cpp.md has its layout. Not while rendering: it allocates.
    std::vector<std::uint32_t> words() const;
};

namespace detail {

// Cumulative masses from 0 to exactly 1; all 0 if there is no mass.
inline void accumulate(const std::vector<double>& masses, std::vector<double>& sums) {
    sums.assign(1, 0.0);
    for (double mass : masses) sums.push_back(sums.back() + mass);
    const double total = sums.back();
    for (double& sum : sums) sum = total > 0.0 ? sum / total : 0.0;
}

// Fewest bits with at least n parts, 1 to 12: more cells than parts are only slower.
inline std::uint32_t guide_bits(std::size_t n) noexcept {
    std::uint32_t made = 1;
    while (made < 12 && std::size_t(1) << made < n) ++made;
    return made;
}

// Last cell that begins at or below each of 2^bits equal parts of [low, low + scale), shifted to the right.
template <class Number, class Part>
void make_guide(const Number* sums, std::size_t cells, double low, double scale, std::uint32_t bits,
                std::uint32_t shift, Part* out) {
    std::size_t k = 0;
    for (std::uint32_t i = 0; i < std::uint32_t(1) << bits; ++i) {
        const double begin = low + scale * double(i) / double(std::uint32_t(1) << bits);
        while (k + 1 < cells && double(sums[k + 1]) <= begin) ++k;
        out[i] = Part(k >> shift);
    }
}

// Sine of 2 pi a for a in [-1/4, 1/4], to 1e-13: its Taylor series.
inline double quarter_sine(double a) noexcept {
    constexpr double t = 4.0 * pi * pi, c1 = -t / 6, c2 = -c1 * t / 20, c3 = -c2 * t / 42, c4 = -c3 * t / 72,
                     c5 = -c4 * t / 110, c6 = -c5 * t / 156, c7 = -c6 * t / 210, c8 = -c7 * t / 272;
    const double q = a * a, q2 = q * q, q4 = q2 * q2;
    return 2.0 * pi * a *
           (((1.0 + q * c1) + q2 * (c2 + q * c3)) + q4 * (((c4 + q * c5) + q2 * (c6 + q * c7)) + q4 * c8));
}

// Cosine and sine of 2 pi u, u in [0, 1].
inline void turn(double u, double& cosine, double& sine) noexcept {
    const double a = u - 0.5, b = std::abs(a);
    cosine = quarter_sine(b - 0.25);
    sine = -std::copysign(quarter_sine(0.25 - std::abs(b - 0.25)), a);
}

}  // namespace detail

inline Result Sampler::prepare(const Table& table, bool joint) {
    *this = Sampler();
    Result result;
    const auto fail = [&](const char* code, const char* message) {
        *this = Sampler();
        result.code = code;
        result.message = message;
        return result;
    };
    const std::size_t n = table.columns;
    if (n < 3 || table.pixels.size() != n * table.rows || table.cos_theta_edges.size() != n + 1)
        return fail("SAMPLER_MASS", "the table is empty; load it first");
    if (joint && table.records == 0)
        return fail("SAMPLER_RECORDS", "the table has no joint records; build it with --joint, or draw without");
    columns = std::uint32_t(n);

    std::vector<double> masses(n), sums;
    for (std::size_t c = 0; c < n; ++c) masses[c] = double(table.row(table.p_theta.first_row)[c]);
    detail::accumulate(masses, theta);
    if (!(theta.back() == 1.0)) return fail("SAMPLER_MASS", "p_theta has no mass to draw from; build the table again");
    cos_theta = table.cos_theta_edges;
    theta_bits = detail::guide_bits(4 * n);
    theta_guide.resize(std::size_t(1) << theta_bits);
    cos_theta_guide.resize(theta_guide.size());
    detail::make_guide(theta.data(), n, 0.0, 1.0, theta_bits, 0, theta_guide.data());
    detail::make_guide(cos_theta.data() + 1, n - 2, -1.0, 2.0, theta_bits, 0, cos_theta_guide.data());
    for (std::uint16_t& column : cos_theta_guide) ++column;
    double total = 0.0;
    for (double mass : masses) total += mass;
    atom_backward = masses.front() / total;
    atom_forward = masses.back() / total;
    per_steradian.assign(n, 0.0);
    for (std::size_t c = 1; c + 1 < n; ++c)
        per_steradian[c] = masses[c] / total / (cos_theta[c + 1] - cos_theta[c]) / (2.0 * pi);

    const Block* const blocks[axes] = {&table.p_r, &table.p_z, &table.p_phi, &table.p_l};
    std::size_t first[axes] = {}, count[axes] = {}, most = 0;  // cells that no column uses only take up the cache
    for (unsigned a = 0; a < axes; ++a) {
        std::size_t last = 0;
        first[a] = blocks[a]->rows;
        for (std::size_t y = 0; y < blocks[a]->rows; ++y) {
            const float* row = table.row(blocks[a]->first_row + y);
            if (std::none_of(row, row + n, [](float v) { return v != 0.0f; })) continue;
            first[a] = (std::min)(first[a], y);
            last = y + 1;
        }
        if (last == 0) return fail("SAMPLER_MASS", "a conditional has no mass to draw from; build the table again");
        count[a] = last - first[a];
        most = (std::max)(most, count[a]);
        start[a + 1] = start[a] + std::uint32_t(count[a] + 1);
        const auto begin = blocks[a]->edges.begin() + std::ptrdiff_t(first[a]);
        edges.insert(edges.end(), begin, begin + std::ptrdiff_t(count[a] + 1));
    }
    bits = detail::guide_bits(most);
    while (most > std::size_t(256) << guide_shift) ++guide_shift;
    cumulative.resize(n * start[axes]);
    guide.resize((n * axes) << bits);
    for (std::size_t c = 0; c < n; ++c)
        for (unsigned a = 0; a < axes; ++a) {
            masses.resize(count[a]);
            for (std::size_t y = 0; y < count[a]; ++y)
                masses[y] = double(table.row(blocks[a]->first_row + first[a] + y)[c]);
            detail::accumulate(masses, sums);
            std::uint32_t* own = cumulative.data() + c * start[axes] + start[a];
            for (std::size_t y = 0; y < count[a]; ++y) own[y] = std::uint32_t(std::nearbyint(sums[y] * one));
            own[count[a]] = one;  // in columns without light, too: nothing may send a search astray
            std::uint8_t* parts = guide.data() + ((c * axes + a) << bits);
            detail::make_guide(own, count[a], 0.0, double(one), bits, guide_shift, parts);
        }

    records = joint ? std::uint32_t(table.records) : 0;
    record.resize(n * records * 4);
    const Block* const fields[4] = {&table.joint_r, &table.joint_z, &table.joint_phi_delta, &table.joint_l};
    for (std::size_t c = 0; c < n; ++c)
        for (std::size_t k = 0; k < records; ++k)
            for (std::size_t i = 0; i < 4; ++i)
                record[4 * (c * records + k) + i] = table.row(fields[i]->first_row + k)[c];
    return result;
}

inline std::vector<std::uint32_t> Sampler::words() const {
    std::vector<std::uint32_t> made(24, 0);
    const auto here = [&made] { return std::uint32_t(made.size()); };
    const auto floats = [&made](const auto& values) {
        for (auto value : values) {
            const auto narrow = float(value);
            std::uint32_t word;
            std::memcpy(&word, &narrow, 4);
            made.push_back(word);
        }
    };
    const auto halves = [&made](const std::vector<std::uint16_t>& values) {
        for (std::size_t i = 0; i < values.size(); i += 2)
            made.push_back(values[i] | std::uint32_t(i + 1 < values.size() ? values[i + 1] : 0) << 16);
    };
    std::vector<std::uint32_t> sums;  // of the columns, in the unit of the others
    for (double sum : theta) sums.push_back(std::uint32_t(std::nearbyint(sum * one)));
    std::vector<std::uint16_t> coarse(theta_guide.size());
    if (columns > 0) detail::make_guide(sums.data(), columns, 0.0, double(one), theta_bits, 0, coarse.data());
    made[0] = columns;
    made[1] = records;
    made[2] = theta_bits;
    made[3] = bits;
    std::copy(start.begin(), start.end(), made.begin() + 4);
    made[18] = guide_shift;
    made[9] = here();
    made.insert(made.end(), sums.begin(), sums.end());
    made[10] = here();
    halves(coarse);
    made[11] = here();
    floats(cos_theta);
    made[12] = here();
    halves(cos_theta_guide);
    made[13] = here();
    floats(per_steradian);
    made[14] = here();
    made.insert(made.end(), cumulative.begin(), cumulative.end());
    made[15] = here();
    for (std::size_t i = 0; i < guide.size(); i += 4) made.push_back(detail::word(guide.data() + i));
    made[16] = here();
    floats(edges);
    made[17] = here();
    floats(record);
    return made;
}

// Two unit vectors that complete a unit vector to a right-handed frame (Duff et al. 2017).
inline void frame(const Vector& n, Vector& a, Vector& b) noexcept {
    const double sign = std::copysign(1.0, n.z), s = -1.0 / (sign + n.z), t = n.x * n.y * s;
    a = {1.0 + sign * n.x * n.x * s, sign * t, -sign * n.x};
    b = {t, sign + n.y * n.y * s, -n.y};
}

// Where light of a unit direction leaves (Algorithm 1, lines 7 and 8); azimuths from the first axis of `frame`,
// right-handed about d_in.
inline Outgoing leave(const Vector& d_in, const Sample& s) noexcept {
    Vector a, b;
    frame(d_in, a, b);
    const auto along = [&](double forward, double across, double turns) {
        double c, q;
        turns += double(turns < 0.0) - double(turns >= 1.0);
        if (!(turns >= 0.0 && turns <= 1.0)) turns -= std::floor(turns);  // no event of a sampler comes here
        detail::turn(turns, c, q);
        c *= across;
        q *= across;
        return Vector{forward * d_in.x + c * a.x + q * b.x, forward * d_in.y + c * a.y + q * b.y,
                      forward * d_in.z + c * a.z + q * b.z};
    };
    const double sine = std::sqrt((std::max)(0.0, 1.0 - s.cos_theta * s.cos_theta)), turns = s.phi_d * (0.5 / pi);
    return {along(s.cos_theta, sine, turns), along(s.z, s.r, turns + s.phi_delta * (0.5 / pi))};
}

}  // namespace tsdf

#endif
