// What tests/test_cpp.py and benchmarks/bench_cpp.py run of tsdf.hpp. Numbers come and go as native 64-bit floats.
#include "../tsdf.hpp"

#include <chrono>
#include <cstdio>
#include <iostream>
#include <iterator>
#include <new>

namespace {

std::size_t allocations = 0;

}  // namespace

// Not inlined, for else GCC 12 takes malloc and delete for a mismatch
[[gnu::noinline]] void* operator new(std::size_t size) {
    ++allocations;
    if (void* made = std::malloc(size > 0 ? size : 1)) return made;
    std::abort();
}
[[gnu::noinline]] void operator delete(void* p) noexcept { std::free(p); }
[[gnu::noinline]] void operator delete(void* p, std::size_t) noexcept { std::free(p); }

namespace {

using Bytes = std::vector<std::uint8_t>;

Bytes read_all(std::istream& in) { return Bytes(std::istreambuf_iterator<char>(in), std::istreambuf_iterator<char>()); }

Bytes read_file(const char* path) {
    std::ifstream file(path, std::ios::binary);
    return read_all(file);
}

void show(const std::string& text) {
    std::putchar('"');
    for (char c : text) {
        if (c == '"' || c == '\\' || (c >= 0 && c < ' '))
            std::printf("\\u%04x", unsigned(c));
        else
            std::putchar(c);
    }
    std::putchar('"');
}

void show(const tsdf::Value& v) {
    using Type = tsdf::Value::Type;
    if (v.type == Type::null) std::printf("null");
    if (v.type == Type::boolean) std::printf(v.truth ? "true" : "false");
    if (v.type == Type::number && v.whole) std::printf("%lld", static_cast<long long>(v.integer));
    if (v.type == Type::number && !v.whole) std::printf("%.17e", v.number);
    if (v.type == Type::text) show(v.text);
    if (v.type != Type::array && v.type != Type::object) return;
    std::putchar(v.type == Type::array ? '[' : '{');
    for (std::size_t i = 0; i < v.items.size(); ++i) {
        if (i > 0) std::putchar(',');
        if (v.type == Type::object) {
            show(v.keys[i]);
            std::putchar(':');
        }
        show(v.items[i]);
    }
    std::putchar(v.type == Type::array ? ']' : '}');
}

void report(const tsdf::Result& result) {
    std::printf("%s|%s|%s|", result.code.c_str(), result.place.c_str(), result.message.c_str());
    for (const tsdf::Finding& warning : result.warnings) std::printf("%s ", warning.code.c_str());
    std::putchar('\n');
}

std::uint64_t mix(std::uint64_t x) {
    x ^= x >> 30;
    x *= 0xbf58476d1ce4e5b9u;
    x ^= x >> 27;
    x *= 0x94d049bb133111ebu;
    return x ^ x >> 31;
}

// Writes the digest that the bytes should have, so that what lies behind it is reached.
void seal(Bytes& bytes) {
    static constexpr char name[] = "tsdf_sha256";  // with its zero byte
    const auto found = std::search(bytes.begin(), bytes.end(), std::begin(name), std::end(name));
    if (bytes.end() - found < 12 + 7 + 4 + 64) return;
    const auto digits = found + 12 + 7 + 4;
    std::fill(digits, digits + 64, std::uint8_t('0'));
    tsdf::detail::Sha256 sha;
    sha.add(bytes.data(), bytes.size());
    const std::string digest = sha.digits();
    std::copy(digest.begin(), digest.end(), digits);
}

// Uses a table as an engine would.
double exercise(const tsdf::Table& table) {
    tsdf::Sampler sampler;
    double sum = table.albedo(1.0) + table.sigma_t(0.5, 1.0, 1.0);
    for (bool joint : {false, true}) {
        if (!sampler.prepare(table, joint)) continue;
        for (int i = 0; i < 64; ++i) {
            const double u = i / 63.0, v = double(mix(std::uint64_t(i)) >> 11) * 0x1p-53;  // 1 too, which it must stand
            const tsdf::Sample s = joint ? sampler.sample_joint(v, u, v) : sampler.sample(v, u, v, u, v, u);
            sum += tsdf::leave({0, 0, -1}, s).offset.x + sampler.pdf(2.2 * u - 1.1);
        }
        sum += double(sampler.words().size());
    }
    return sum;
}

int fuzz(int count, char** paths, unsigned variants) {
    std::uint64_t counter = 1, loaded = 0, tried = 0;
    double sum = 0.0;
    for (int f = 0; f < count; ++f) {
        const Bytes sound = read_file(paths[f]);
        for (unsigned v = 0; v < variants; ++v, ++tried) {
            const auto draw = [&counter](std::size_t below) {
                return below > 0 ? std::size_t(mix(counter++ * 0x9e3779b97f4a7c15u) % below) : 0;
            };
            Bytes bytes = sound;
            if (v % 4 == 3) bytes.resize(draw(bytes.size() + 1));
            if (bytes.empty()) continue;
            for (std::size_t flips = draw(4) + (v % 4 != 3); flips > 0; --flips) {
                // every other one near the end, where the chunks are
                const std::size_t span = v % 2 ? bytes.size() : (std::min)(bytes.size(), std::size_t(400));
                bytes[bytes.size() - 1 - draw(span)] ^= std::uint8_t(1 + draw(255));
            }
            if (v % 8 != 0) seal(bytes);
            bytes.shrink_to_fit();  // so that the sanitizer sees a step beyond the end
            tsdf::Table table;
            if (tsdf::parse(bytes.data(), bytes.size(), table)) {
                ++loaded;
                sum += exercise(table);
            }
        }
    }
    std::printf("%llu of %llu loaded, %s\n", static_cast<unsigned long long>(loaded),
                static_cast<unsigned long long>(tried), std::isfinite(sum) ? "finite" : "not finite");
    return 0;
}

double bench(const tsdf::Sampler& sampler, bool joint, unsigned events) {
    tsdf::Vector d{0, 0, 1};
    double total = 0.0;
    std::uint64_t counter = 1;
    const auto u = [&counter](double& first, double& second) {
        const std::uint64_t word = mix(counter);
        counter += 0x9e3779b97f4a7c15u;
        first = double(word >> 32) * 0x1p-32;
        second = double(word & 0xffffffff) * 0x1p-32;
    };
    for (unsigned i = 0; i < events; ++i) {
        double a, b, c, e, f, g;
        u(a, b);
        u(c, e);
        if (!joint) u(f, g);
        const tsdf::Sample s = joint ? sampler.sample_joint(a, b, c) : sampler.sample(a, b, c, e, f, g);
        const tsdf::Outgoing out = tsdf::leave(d, s);
        d = out.d_out;
        total += out.offset.x + out.offset.y + out.offset.z + s.path_length;
    }
    return total;
}

void write(const std::vector<double>& values) { std::fwrite(values.data(), sizeof(double), values.size(), stdout); }

}  // namespace

int main(int argc, char** argv) {
    const std::string mode = argc > 2 ? argv[1] : "";
    if (mode == "codes") {  // codes FILE...
        for (int i = 2; i < argc; ++i) {
            tsdf::Table table;
            report(tsdf::load(argv[i], table));
        }
        return 0;
    }
    if (mode == "batch") {  // batch FILE: files one after the other, each after its size in 8 bytes
        const Bytes all = read_file(argv[2]);
        for (std::size_t at = 0; at + 8 <= all.size();) {
            const std::size_t size = tsdf::detail::word(all.data() + at);
            const Bytes one(all.begin() + std::ptrdiff_t(at + 8), all.begin() + std::ptrdiff_t(at + 8 + size));
            tsdf::Table table;
            report(tsdf::parse(one.data(), one.size(), table));
            at += 8 + size;
        }
        return 0;
    }
    if (mode == "fuzz" && argc > 3) return fuzz(argc - 3, argv + 3, unsigned(std::atoi(argv[2])));  // fuzz N FILE...

    tsdf::Table table;
    const tsdf::Result result = argc > 2 ? tsdf::load(argv[2], table) : tsdf::Result{"USAGE", "", "", {}};
    if (!result) {
        std::fprintf(stderr, "%s: %s\n", result.code.c_str(), result.message.c_str());
        return 1;
    }
    if (mode == "header") return show(table.header), 0;
    if (mode == "pixels") {
        std::fwrite(table.pixels.data(), sizeof(float), table.pixels.size(), stdout);
        return 0;
    }
    if (mode == "medium" && argc == 6) {  // medium FILE f R sigma_a
        const double f = std::atof(argv[3]), radius = std::atof(argv[4]), sigma_a = std::atof(argv[5]);
        const tsdf::FreePath path = table.free_path(f, radius);
        const tsdf::VolumeParameters volume = table.volume_parameters(f, radius, sigma_a);
        return write({path.lambda_b, path.lambda_delta, path.lambda_beta, path.lambda_s, volume.sigma_t, volume.albedo,
                      volume.g}), 0;
    }
    const bool joint = argc > 3 && std::strcmp(argv[3], "joint") == 0;
    tsdf::Sampler sampler;
    const tsdf::Result prepared = sampler.prepare(table, joint);
    if (!prepared) return std::fprintf(stderr, "%s: %s\n", prepared.code.c_str(), prepared.message.c_str()), 1;
    if (mode == "words") {
        const std::vector<std::uint32_t> words = sampler.words();
        std::fwrite(words.data(), sizeof(std::uint32_t), words.size(), stdout);
        return 0;
    }
    if (mode == "frugal") {  // frugal FILE joint|apart: allocations of a thousand events and densities
        const std::size_t before = allocations;
        volatile double sink = bench(sampler, joint, 1000);
        for (int i = -1100; i < 1100; ++i) sink = sink + sampler.pdf(i * 1e-3) + table.albedo(i * 1e-3);
        sink = sink + table.mean_cosine(0.5) + table.volume_parameters(0.5, 1.0, 1.0).sigma_t;
        std::printf("%llu\n", static_cast<unsigned long long>(allocations - before));
        return 0;
    }
    if (mode == "bench") {  // bench FILE joint|apart EVENTS ROUNDS: nanoseconds an event of each round
        const auto events = unsigned(std::atoi(argv[4]));
        volatile double sink = bench(sampler, joint, events);
        for (int round = std::atoi(argv[5]); round > 0; --round) {
            const auto begin = std::chrono::steady_clock::now();
            sink = sink + bench(sampler, joint, events);
            const std::chrono::duration<double, std::nano> taken = std::chrono::steady_clock::now() - begin;
            std::printf("%.3f\n", taken.count() / events);
        }
        return 0;
    }
    const Bytes input = read_all(std::cin);
    std::vector<double> u(input.size() / sizeof(double));
    if (!u.empty()) std::memcpy(u.data(), input.data(), u.size() * sizeof(double));
    if (mode == "pdf") {  // pdf FILE apart < cosines: per cosine and per steradian
        for (double cosine : u) write({sampler.pdf(cosine), sampler.pdf_solid_angle(cosine)});
        return 0;
    }
    if (mode == "sample") {  // sample FILE joint|apart < six numbers and a direction for each event
        for (std::size_t i = 0; i + 9 <= u.size(); i += 9) {
            const double* p = u.data() + i;
            const tsdf::Sample s = joint ? sampler.sample_joint(p[0], p[1], p[2])
                                         : sampler.sample(p[0], p[1], p[2], p[3], p[4], p[5]);
            const tsdf::Outgoing out = tsdf::leave({p[6], p[7], p[8]}, s);
            write({s.cos_theta, s.phi_d, s.r, s.z, s.phi_delta, s.path_length, double(s.column)});
            write({out.d_out.x, out.d_out.y, out.d_out.z, out.offset.x, out.offset.y, out.offset.z});
        }
        return 0;
    }
    std::fprintf(stderr, "usage: check_tsdf codes|batch|fuzz|header|pixels|medium|words|frugal|bench|pdf|sample FILE ...\n");
    return 2;
}
