// Reads golden vectors and writes them again: rewrite_vectors FROM_FOLDER TO_FOLDER. The tests compare the two.
#include <filesystem>
#include <fstream>
#include <iostream>
#include <iterator>

#include "messages.hpp"

namespace fs = std::filesystem;

namespace {

pot::Bytes rewritten(const std::string& name, const pot::Bytes& bytes) {
    const auto is = [&name](const char* schema) { return name.rfind(std::string(schema) + ".", 0) == 0; };
    if (is("pot.cloud.v1")) return pot::written(pot::read_cloud(bytes));
    if (is("pot.points_query.v1")) return pot::written(pot::read_points_query(bytes));
    if (is("pot.occupancy.v1")) return pot::written(pot::read_occupancy(bytes));
    if (is("pot.receipt.v1")) return pot::written(pot::read_receipt(bytes));
    if (is("pot.error.v1")) return pot::written(pot::read_error(bytes));
    return {};
}

}  // namespace

int main(int argc, char** argv) {
    if (argc != 3) {
        std::cerr << "usage: rewrite_vectors FROM_FOLDER TO_FOLDER\n";
        return 2;
    }
    int n_files = 0;
    for (const auto& entry : fs::directory_iterator(argv[1])) {
        const fs::path path = entry.path();
        if (path.extension() != ".msgpack") continue;
        std::ifstream in(path, std::ios::binary);
        const pot::Bytes bytes{std::istreambuf_iterator<char>(in), {}};
        const pot::Bytes again = rewritten(path.filename().string(), bytes);
        if (again.empty()) continue;  // a message that this example does not speak
        std::ofstream out(fs::path(argv[2]) / path.filename(), std::ios::binary);
        out.write(reinterpret_cast<const char*>(again.data()), static_cast<std::streamsize>(again.size()));
        ++n_files;
    }
    std::cout << n_files << " vectors rewritten\n";
    return 0;
}
