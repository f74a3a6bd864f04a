// Five messages of the wire contract (schemas/README.md), to MessagePack and back, with msgpack-cxx.
#pragma once

#include <cstdint>
#include <cstring>
#include <map>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include <msgpack.hpp>

namespace pot {

using Bytes = std::vector<uint8_t>;
using Fields = std::map<std::string, msgpack::object>;
using Packer = msgpack::packer<msgpack::sbuffer>;

// An array in C order, little-endian: the numbers of this machine are taken as they are.
struct Array {
    std::string dtype;  // "<f4", "<f8", "<i8", "|u1" or "|b1"
    std::vector<int64_t> shape;
    std::vector<char> data;

    template <typename T>
    static Array of(std::string dtype, std::vector<int64_t> shape, const std::vector<T>& values) {
        const auto* first = reinterpret_cast<const char*>(values.data());
        return {std::move(dtype), std::move(shape), {first, first + values.size() * sizeof(T)}};
    }

    template <typename T>
    std::vector<T> values() const {
        std::vector<T> out(data.size() / sizeof(T));
        std::memcpy(out.data(), data.data(), out.size() * sizeof(T));
        return out;
    }
};

struct Cloud {  // pot.cloud.v1
    int64_t seq = 0, stamp_ns = 0;
    Array points;                       // (N, 3) float32, m, sensor frame
    std::optional<Array> T_map_sensor;  // (4, 4) float64, row-major
    std::optional<Array> is_return;     // (N,) bool; none: all beams have an echo
    std::optional<std::string> robot;
    std::optional<std::string> session;  // of this run of the program: seq grows within it
    std::optional<std::string> params;   // which kernels come back: fitted, transported or none
};

struct PointsQuery {  // pot.points_query.v1
    Array points;     // (N, 3) float32 or float64, m, map frame
    std::optional<double> deadline_ms;
    std::optional<bool> with_gradient;
    std::optional<bool> evidence_only;  // true: what is not observed is unknown
};

struct Occupancy {  // pot.occupancy.v1, without gradients
    Array mean, var, latent_mean, latent_var, observed;
    int64_t map_revision = 0;
    std::optional<Array> borrowed;  // (N,) float32: how much of each answer the dictionary expects and no evidence says
};

struct Receipt {  // pot.receipt.v1, the fields that a robot acts on
    std::string map, robot, status;
    int64_t seq = 0, map_revision = 0;
    std::optional<std::string> reason, message;
};

struct Error {  // pot.error.v1
    std::string code, message;
    bool retryable = false;
    std::optional<double> retry_after_s;
    std::optional<std::string> reason;
};

// --- reading -----------------------------------------------------------------------------------------------------------

inline Fields fields_of(const msgpack::object& object) { return object.as<Fields>(); }

template <typename T>
T required(const Fields& fields, const std::string& name) {
    const auto found = fields.find(name);
    if (found == fields.end()) throw std::runtime_error("field " + name + " is missing");
    return found->second.as<T>();
}

template <typename T>
std::optional<T> optional(const Fields& fields, const std::string& name) {
    const auto found = fields.find(name);
    if (found == fields.end() || found->second.is_nil()) return std::nullopt;
    return found->second.as<T>();
}

inline Array array_of(const msgpack::object& object) {
    const Fields fields = fields_of(object);
    Array array{required<std::string>(fields, "dtype"), required<std::vector<int64_t>>(fields, "shape"),
                required<std::vector<char>>(fields, "data")};
    size_t n_bytes = array.dtype == "<f8" || array.dtype == "<i8" ? 8 : array.dtype == "<f4" ? 4 : 1;
    for (const int64_t n : array.shape) n_bytes *= static_cast<size_t>(n);
    if (n_bytes != array.data.size()) throw std::runtime_error("an array's bytes are not those of its shape");
    return array;
}

inline Array required_array(const Fields& fields, const std::string& name) {
    return array_of(required<msgpack::object>(fields, name));
}

inline std::optional<Array> optional_array(const Fields& fields, const std::string& name) {
    const auto found = optional<msgpack::object>(fields, name);
    return found ? std::optional(array_of(*found)) : std::nullopt;
}

inline msgpack::object_handle unpacked(const Bytes& bytes) {
    return msgpack::unpack(reinterpret_cast<const char*>(bytes.data()), bytes.size());
}

inline Cloud read_cloud(const Bytes& bytes) {
    const auto handle = unpacked(bytes);
    const Fields f = fields_of(handle.get());
    return {required<int64_t>(f, "seq"),       required<int64_t>(f, "stamp_ns"),
            required_array(f, "points"),       optional_array(f, "T_map_sensor"),
            optional_array(f, "is_return"),    optional<std::string>(f, "robot"),
            optional<std::string>(f, "session"), optional<std::string>(f, "params")};
}

inline PointsQuery read_points_query(const Bytes& bytes) {
    const auto handle = unpacked(bytes);
    const Fields f = fields_of(handle.get());
    return {required_array(f, "points"), optional<double>(f, "deadline_ms"), optional<bool>(f, "with_gradient"),
            optional<bool>(f, "evidence_only")};
}

inline Occupancy read_occupancy(const Bytes& bytes) {
    const auto handle = unpacked(bytes);
    const Fields f = fields_of(handle.get());
    return {required_array(f, "mean"),       required_array(f, "var"),      required_array(f, "latent_mean"),
            required_array(f, "latent_var"), required_array(f, "observed"), required<int64_t>(f, "map_revision"),
            optional_array(f, "borrowed")};
}

inline Receipt read_receipt(const Bytes& bytes) {
    const auto handle = unpacked(bytes);
    const Fields f = fields_of(handle.get());
    return {required<std::string>(f, "map"),
            required<std::string>(f, "robot"),
            required<std::string>(f, "status"),
            required<int64_t>(f, "seq"),
            optional<int64_t>(f, "map_revision").value_or(0),
            optional<std::string>(f, "reason"),
            optional<std::string>(f, "message")};
}

inline Error read_error(const Bytes& bytes) {
    const auto handle = unpacked(bytes);
    const Fields f = fields_of(handle.get());
    return {required<std::string>(f, "code"), required<std::string>(f, "message"),
            optional<bool>(f, "retryable").value_or(false), optional<double>(f, "retry_after_s"),
            optional<std::string>(f, "reason")};
}

// --- writing -----------------------------------------------------------------------------------------------------------

class Writer {  // one map of named fields
   public:
    explicit Writer(uint32_t n_fields) : packer_(buffer_) { packer_.pack_map(n_fields); }

    template <typename T>
    Writer& field(const std::string& name, const T& value) {
        packer_.pack(name);
        put(value);
        return *this;
    }

    Bytes bytes() const { return {buffer_.data(), buffer_.data() + buffer_.size()}; }

   private:
    template <typename T>
    void put(const T& value) {
        packer_.pack(value);
    }
    template <typename T>
    void put(const std::optional<T>& value) {
        if (value) {
            put(*value);
        } else {
            packer_.pack_nil();
        }
    }
    void put(const Array& array) {
        packer_.pack_map(3);
        packer_.pack(std::string("dtype")).pack(array.dtype);
        packer_.pack(std::string("shape")).pack(array.shape);
        packer_.pack(std::string("data"));
        packer_.pack_bin(static_cast<uint32_t>(array.data.size()));
        packer_.pack_bin_body(array.data.data(), static_cast<uint32_t>(array.data.size()));
    }

    msgpack::sbuffer buffer_;
    Packer packer_;
};

inline Bytes written(const Cloud& c) {
    Writer writer(6 + (c.session ? 1 : 0) + (c.params ? 1 : 0));  // fields that were added later are left out, never nil
    writer.field("seq", c.seq).field("stamp_ns", c.stamp_ns).field("points", c.points);
    writer.field("T_map_sensor", c.T_map_sensor).field("is_return", c.is_return).field("robot", c.robot);
    if (c.session) writer.field("session", *c.session);
    if (c.params) writer.field("params", *c.params);
    return writer.bytes();
}

inline Bytes written(const PointsQuery& q) {
    Writer writer(2 + (q.with_gradient ? 1 : 0) + (q.evidence_only ? 1 : 0));
    writer.field("points", q.points).field("deadline_ms", q.deadline_ms);
    if (q.with_gradient) writer.field("with_gradient", *q.with_gradient);
    if (q.evidence_only) writer.field("evidence_only", *q.evidence_only);
    return writer.bytes();
}

inline Bytes written(const Occupancy& o) {
    Writer writer(o.borrowed ? 7 : 6);
    writer.field("mean", o.mean).field("var", o.var).field("latent_mean", o.latent_mean);
    writer.field("latent_var", o.latent_var).field("observed", o.observed).field("map_revision", o.map_revision);
    if (o.borrowed) writer.field("borrowed", *o.borrowed);
    return writer.bytes();
}

inline Bytes written(const Receipt& r) {
    Writer writer(7);
    writer.field("map", r.map).field("robot", r.robot).field("seq", r.seq).field("status", r.status);
    writer.field("reason", r.reason).field("message", r.message).field("map_revision", r.map_revision);
    return writer.bytes();
}

inline Bytes written(const Error& e) {
    Writer writer(e.reason ? 5 : 4);
    writer.field("code", e.code).field("message", e.message).field("retryable", e.retryable);
    writer.field("retry_after_s", e.retry_after_s);
    if (e.reason) writer.field("reason", *e.reason);
    return writer.bytes();
}

}  // namespace pot
