// `forward` of an exported file: MODEL SAMPLES TRACES.f32 -> action and reason of each trace, a line each.
#include <torch/script.h>

#include <fstream>
#include <iostream>
#include <string>
#include <vector>

int main(int, char** argv) {
    torch::InferenceMode inference;
    torch::jit::Module module = torch::jit::load(argv[1]);
    module.eval();
    std::vector<float> samples(std::stoul(argv[2]));
    std::ifstream traces(argv[3], std::ios::binary);
    auto const bytes = static_cast<std::streamsize>(samples.size() * sizeof(float));
    while (traces.read(reinterpret_cast<char*>(samples.data()), bytes)) {
        auto const trace = torch::tensor(samples);
        auto const decision = module.forward({trace}).toTuple()->elements();
        std::cout << decision[0].toInt() << ' ' << decision[1].toInt() << '\n';
    }
}
